"""CVC-SSL training (Sec. Cross-View Consistency Self-Supervised Learning): ``python -m arbiview_aug.train --help``.

Needs accelerate besides what the generator needs: ``pip install arbiview_aug[generator]``.
"""
