"""CVC-SSL training (Sec. Cross-View Consistency Self-Supervised Learning): ``python -m arbiview_aug train --help``.

Needs accelerate and the generator's packages: ``pip install arbiview_aug[generator]``.
"""
