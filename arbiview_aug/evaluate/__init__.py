"""How good is a rendered view? Plain functions on cameras, rigs and (h, w, 3) images.

``sparse``: against LiDAR points coloured by the source cameras (the paper's measure). ``overlap``: two cameras'
renderings of one view; ``consistency``: of two rendered views. ``truth``: against a true view. ``targets``: the rigs to
evaluate on. ``frames``: what a method gets and what scores it. ``methods`` and ``baselines``: what renders, by name.
``pictures``, ``sheet``, ``report``: to look at. ``command``: all of it on the command line.
"""
