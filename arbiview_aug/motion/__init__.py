"""Depth from motion: how far the scene is, from frames of a drive a metre apart. Offline work, cached beside the data.

``sweep`` reads neighbouring frames over a family of surfaces and scores how alike they are, ``aggregation`` makes the
scores agree along the image, ``depth`` keeps what both sides say, ``poses`` declines where poses are too poor for it.
"""
