"""Plans as plain arrays, for a runtime without this package.

An export holds the constants of a fixed pair of rigs: positions, second sources and their weights.
Exposure is not matched and holes stay black.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.atomic_io import whole_file
from arbiview_aug.render.plan import RenderPlan, ViewPlan

LAYOUT_VERSION = 1


def export_plan(plan: RenderPlan, path: str | Path) -> None:
    """Write a plan as a ``.npz`` of plain arrays, for ``cv2.remap``; ``docs/deploy.md`` lists them.

    Views made from it equal those of ``RigRetarget`` with ``match_exposure=False`` and ``holes="black"`` on images
    alone, up to one grey level.

    Args:
        plan: Plan of a fixed pair of rigs, from ``RigRetarget.prepare``; ``auto`` plans the street.
        path: The file; its folder is created.

    Raises:
        ValueError: Not a plan, a plan of ``quality="accurate"``, or a path that does not end in ``.npz``.
        OutputError: The file cannot be written.
    """
    if not isinstance(plan, RenderPlan):
        raise ValueError(f"plan: expected what RigRetarget.prepare returns, got {type(plan).__name__}")
    if plan.config.overlap_depth:
        raise ValueError(
            "plan: expected one that all frames share, got one of quality='accurate', which corrects distances in "
            "every frame; prepare it with quality='fast'"
        )
    if not isinstance(path, str | Path) or Path(path).suffix != ".npz":
        raise ValueError(f"path: expected a file name that ends in .npz, got {path!r}")
    slots = [(slot.source, slot.level, slot.y, slot.x, *slot.size) for slot in plan.layout.slots]
    arrays: dict[str, Any] = {
        "version": LAYOUT_VERSION,
        "source_names": plan.source.names,
        "source_sizes": plan.source.sizes,
        "target_names": plan.target.names,
        "atlas_size": plan.layout.size,
        "slots": np.array(slots, np.int32).reshape(-1, 6),
    }
    for number, view in enumerate(plan.targets):
        arrays |= {f"{name}_{number}": values for name, values in _view_arrays(view).items()}
    with whole_file(Path(path)) as file:
        np.savez_compressed(file, **arrays)


def _view_arrays(view: ViewPlan) -> dict[str, Any]:
    (h, w), first, seam = view.source_camera.shape, view.at.to_float(), view.seam
    second, weight = np.full((h, w, 2), -16, np.float32), np.zeros((h, w), np.float32)
    second_source, is_linear = np.full((h, w), -1, np.int8), np.full((h, w), view.interpolation == "linear")
    second.reshape(-1, 2)[seam.pixel] = seam.at.to_float()[0]
    weight.flat[seam.pixel], second_source.flat[seam.pixel] = seam.weight, seam.source
    if view.edge is not None:
        is_linear.flat[view.edge] = True
    return {
        "map_x": first[..., 0],
        "map_y": first[..., 1],
        "source": view.source_camera,
        "interpolation": view.interpolation,
        "seam_interpolation": view.seam_interpolation,
        "linear": is_linear,
        "second_x": second[..., 0],
        "second_y": second[..., 1],
        "second_source": second_source,
        "weight": weight,
    }
