"""The paper's Figures 2 to 6 on a frame of one's own: originals and methods × cameras × configurations."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from arbiview_aug.errors import CalibrationError, SampleError
from arbiview_aug.evaluate.images import Image, as_arrays
from arbiview_aug.evaluate.methods import Method, baseline, has_generator, retargeting
from arbiview_aug.evaluate.pictures import contact_sheet, save_picture
from arbiview_aug.evaluate.sheet import left_to_right
from arbiview_aug.evaluate.targets import paper_target, spacing_deg
from arbiview_aug.rig import Rig

FIGURES: dict[int, tuple[float, ...]] = {2: (0.5, -0.25), 3: (0.2,), 4: (-0.2,), 5: (0.4,), 6: (-0.4,)}
"""The paper's figures, and the shares of the azimuth spacing by which their cameras are turned."""

_WIDTH_PX = 1800


def figure_methods() -> dict[str, Method]:
    """The paper's rows by their caption, and ours."""
    methods = {
        "DriveSuprim: crop and slide": baseline("crop and slide"),
        "geometric: own camera, no fusion": baseline("own camera"),
        "FAVS as published": retargeting("paper"),
        "fast, street": retargeting("fast", "street"),
    }
    if has_generator():
        methods["fast, street, holes generated"] = retargeting("fast", "street", path="diffusion")
    return methods


def draw_figures(sample: Mapping[str, Any], folder: Path) -> list[Path]:
    """Write ``figure2.png`` to ``figure6.png``.

    Args:
        sample: With ``rig`` and ``images``.
        folder: Where to.

    Returns:
        The files. A method that cannot take the rig's lenses has no row.
    """
    rig: Rig = sample["rig"]
    images: list[Image] = as_arrays(sample["images"])
    order, spacing = left_to_right(rig), spacing_deg(rig)
    files = []
    for number, shares in FIGURES.items():
        rows: list[list[Image]] = [[images[k] for k in order]]
        titles, labels = ["Recorded"], [[rig.names[k] for k in order]]
        for share in shares:
            target = paper_target(rig, share)
            for name, method in figure_methods().items():
                try:
                    views = method.render(sample, target)
                except (CalibrationError, SampleError):
                    continue
                rows.append([views[k].image for k in order])
                titles.append(name)
                labels.append([f"{rig.names[k]} {share * spacing[k]:+.4g} deg" for k in order])
        picture = contact_sheet(rows, labels, titles=titles, width_px=_WIDTH_PX)
        files.append(save_picture(folder / f"figure{number}.png", picture))
    return files
