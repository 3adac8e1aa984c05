"""CVC-SSL training (Sec. Cross-View Consistency Self-Supervised Learning): ``python -m arbiview_aug.train --help``.

Needs accelerate besides what the generator needs: ``pip install arbiview_aug[generator]``.

- ``config``: settings and the four configurations; ``data``: frames and their split by scenes;
- ``pseudo_views``: the items of Algorithm 1; ``masks``: hole masks of targets;
- ``losses``, ``step``: L_main, L_geo, L_perceptual; ``autoencoder``: the first stage;
- ``checkpointing``, ``trainer``: the run; ``measure``, ``held_out``, ``ablation``: its scores.
"""
