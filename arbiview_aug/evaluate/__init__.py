"""How good is a rendered view? Plain functions on cameras, rigs and (h, w, 3) images.

``sparse``: against LiDAR points coloured by the source cameras (the paper's measure). ``overlap``: two cameras'
renderings of one view. ``truth``: against a true view. ``targets``: the rigs to evaluate on. ``pictures``: to look at.
"""
