"""Sparse points made dense, as one centre sees them: panoramas of inverse distance with edges kept.

A panorama has one cell per 0.2 degrees of azimuth and elevation, or per 0.4 for a coarse view. Its cells hold
*residuals* against a static surface, so that a road stays a plane between the scan lines, and what no point tells fades
back to the static surface. A cell at a step from near to far holds both, and the share of near ones around
it; the outline runs where the share is one half. Interpolating the two layers and the share apart keeps outlines sharp
between the cells too.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Layer = npt.NDArray[np.float32]

CELL_RAD = math.radians(0.2)
"""Two pixels of a camera of 800 px and 65 degrees; spinning LiDARs sample 0.1 to 0.4 degrees along their lines.
0.15 to 0.21 degrees lie within 1 dB of each other on nuScenes, in no order: that much depends on where cells fall."""

SEE_THROUGH_RAD = math.radians(2.0)
"""A point is occluded where nearer ones lie on both sides of it within this angle: one and a half of the spacing of 32
scan lines. 1 degree loses 0.2 to 1.2 dB on moved views of nuScenes and DDAD, 2.5 is as good."""

SIDE_RAD = math.radians(0.75)
"""... and off that line by no more than this: half the spacing of 32 scan lines."""

SMOOTH_RAD = math.radians(1.3)
"""Window in which residuals are averaged and outlines straightened: the spacing of 32 scan lines, over which an average
of nearest values is linear interpolation. 0.75 degrees gains 0.1 dB, but walls wave by 4 % between the lines; 1.6 loses
0.7 dB on nuScenes."""

STEP = 0.1
"""Relative change of inverse distance within that window that makes an outline; 0.2 is as good."""

STEP_PER_M = 0.003
"""... and the least absolute one, 1/m: two pixels of parallax for 1 m of baseline."""

REACH_RAD = math.radians(12.0)
"""Beyond this angle from any point the static surface is all that is known. From half of it the points fade out: above
the highest scan line houses and trees go on, and a fade over a few degrees bends them (seen on both frames)."""

SUPPORT_RAD = math.radians(0.75)
"""A ray this near to a point is measured: just over half the spacing of 32 scan lines."""

SHRINK_RAD = math.radians(0.4)
"""A measured surface hides what is behind it; this closes gaps between scan lines without widening outlines by all of
``SUPPORT_RAD``. With 0.2 degrees false holes cost 0.1 to 1 dB on nuScenes and DDAD."""

NEAREST_M = 0.5
"""Nearer to a centre than this nothing of the scene stands: such points are the vehicle's, or the camera itself."""

BASE_STEP = 4  # cells, 0.8 or 1.6 degrees: a static surface is smooth
HALO_RAD = math.radians(4.0)
"""Room around a window that its filters need."""

OWN_CAR_M = ((-1.5, 4.0), (-1.3, 1.3))
"""(x, y) ranges in the ego frame whose returns are the own car's: a car's about the middle of its rear axle."""
