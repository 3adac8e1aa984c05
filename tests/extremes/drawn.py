"""Rigs drawn by hypothesis: any lens, direction, place and mask, on images large enough for the coarse grid."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import reject
from hypothesis import strategies as st

from arbiview_aug import Camera, Rig
from arbiview_aug.errors import CalibrationError

SIZES = ((66, 96), (64, 71), (97, 65), (30, 50))  # the last one is evaluated pixel by pixel
CENTER_M = (1.0, 0.2, 1.55)


def small(limit: float) -> st.SearchStrategy[float]:
    """A coefficient, often 0."""
    return st.one_of(st.just(0.0), st.floats(-limit, limit))


@st.composite
def cameras(draw: st.DrawFn, name: str, azimuth_deg: float | None = None, masked: bool = True) -> Camera:
    """A camera within 1.5 m of the others; one in three at the common centre, one in four with an own car in view."""
    lens = draw(st.sampled_from(("pinhole", "pinhole", "radtan", "wide")))
    if lens == "wide":
        lens = draw(st.sampled_from(("fisheye", "ftheta", "ftheta_backward", "double_sphere", "eucm")))
    h, w = draw(st.sampled_from(SIZES))
    values: dict[str, Any] = {"lens": lens, "width_px": w, "height_px": h}
    values["horizontal_fov_deg"] = draw(st.floats(*{"pinhole": (20, 150), "radtan": (20, 80)}.get(lens, (40, 200))))
    if lens == "radtan":
        values["distortion"] = tuple(draw(small(limit)) for limit in (0.2, 0.05, 0.01, 0.01, 0.02))
    if lens in ("fisheye", "ftheta", "ftheta_backward"):
        values["distortion"] = tuple(draw(small(0.02)) for _ in range(4))
    elif lens == "double_sphere":
        values["distortion"] = draw(st.floats(-0.5, 0.5)), draw(st.floats(0.3, 0.8))
    elif lens == "eucm":
        values["distortion"] = draw(st.floats(0.3, 0.8)), draw(st.floats(0.5, 2))
    values["position_m"] = draw(
        st.one_of(
            st.just(CENTER_M), st.just((1.0, 0.2, 2.1)), st.tuples(*(st.floats(a, a + 1.5) for a in (0, -0.75, 0.8)))
        )
    )
    values["azimuth_deg"] = draw(st.floats(-180, 180)) if azimuth_deg is None else azimuth_deg
    values["elevation_deg"] = draw(st.one_of(st.just(0.0), st.floats(-90, 90)))
    values["roll_deg"] = draw(st.one_of(st.just(0.0), st.floats(-180, 180)))
    if masked and draw(st.integers(0, 3)) == 0:
        values["mask"] = np.ones((h, w), bool)
        y, x = draw(st.integers(0, h - 20)), draw(st.integers(0, w - 20))
        values["mask"][y : y + 20, x : x + 20] = False
    try:
        return Camera.looking(name=name, **values)
    except CalibrationError:  # the field of view ends past the lens's fold
        reject()


@st.composite
def pairs(draw: st.DrawFn, masked: bool = True) -> tuple[Rig, Rig]:
    """A source and a target rig; the target's first camera looks where the source's first one looks, roughly."""
    count = draw(st.integers(1, 3))
    source = Rig([draw(cameras(f"s{k}", masked=masked)) for k in range(count)], ground_z_m=draw(small(0.4)))
    near = source[0].azimuth_deg + draw(st.floats(-30, 30))
    more = [draw(cameras(f"t{k}")) for k in range(1, draw(st.integers(1, 3)))]
    return source, Rig([draw(cameras("t0", near)), *more], ground_z_m=source.ground_z_m)
