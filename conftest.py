"""One thread for each process of the tests, set before torch, OpenCV and numba read it; ``-n`` and programs inherit it.

Set in the shell, the variables stay as they are.
"""

import os

for name in ("OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(name, "1")
