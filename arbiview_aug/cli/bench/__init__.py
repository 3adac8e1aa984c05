"""``python -m arbiview_aug bench [WHAT]``: repeatable measurements, one module each."""
