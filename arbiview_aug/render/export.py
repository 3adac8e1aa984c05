"""Plans as files that need no arbiview_aug: plain arrays, ONNX, TorchScript.

They hold what comes back for a fixed pair of rigs: positions, second sources and their weights. Exposure is not matched
and holes stay black.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch

from arbiview_aug.atomic_io import whole_file
from arbiview_aug.environment import optional_package
from arbiview_aug.render.plan import RenderPlan, ViewPlan
from arbiview_aug.render.torch_backend import render_torch

LAYOUT_VERSION = 1
_OPSET = 16  # the first with GridSample


def export_plan(plan: RenderPlan, path: str | Path) -> None:
    """Write a plan for a runtime without this package, by the ending of ``path``; see ``docs/deploy.md``.

    ``.npz``: plain arrays, for ``cv2.remap``. ``.onnx`` (extra ``export``) and ``.pt``, TorchScript: N images (3, H, W)
    uint8 in, M views (3, h, w) uint8 out. To one level they are those of ``RigRetarget`` with ``match_exposure=False``
    and ``holes="black"`` on images alone.

    Args:
        plan: Plan of a fixed pair of rigs, from ``RigRetarget.prepare``; ``auto`` plans the street.
        path: The file; its folder is created.

    Raises:
        ValueError: Another ending, no name, no plan, or one of ``quality="accurate"``.
        ImportError: ``.onnx`` without the package onnx.
        OutputError: A file that cannot be written.
    """
    if not isinstance(plan, RenderPlan):
        raise ValueError(f"plan: expected what RigRetarget.prepare returns, got {type(plan).__name__}")
    if plan.config.overlap_depth:
        raise ValueError(
            "plan: expected one that all frames share, got one of quality='accurate', which corrects distances in "
            "every frame; prepare it with quality='fast'"
        )
    if not isinstance(path, str | Path):
        raise ValueError(f"path: expected a file's name, got {type(path).__name__}")
    path = Path(path)
    write = _WRITERS.get(path.suffix)
    if write is None:
        raise ValueError(f"{path}: expected a name ending in {', '.join(_WRITERS)}, got {path.suffix!r}")
    with whole_file(path) as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's, of tracing constants and of what will be deprecated
        write(plan, file)


def plan_arrays(plan: RenderPlan) -> dict[str, Any]:
    """The arrays of an ``.npz`` export by name; ``docs/deploy.md`` describes them."""
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
    return arrays


def _view_arrays(view: ViewPlan) -> dict[str, Any]:
    size = view.source_camera.shape
    first, second = view.at.to_float(), np.full((*size, 2), -16, np.float32)
    weight, second_source = np.zeros(size, np.float32), np.full(size, -1, np.int8)
    is_linear = np.full(size, view.interpolation == "linear")
    for band in view.bands:
        h, w = band.weight.shape
        place = slice(band.y, band.y + h), slice(band.x, band.x + w)
        reads = band.weight > 0
        second[place][reads], weight[place][reads] = band.at.to_float()[reads], band.weight[reads]
        second_source[place][reads] = band.source
    if view.edge is not None:
        is_linear.reshape(-1)[view.edge] = True
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


class PlanModule(torch.nn.Module):
    """A plan as a network: N images (3, H, W) uint8 in, one argument each, M views (3, h, w) uint8 out.

    An ONNX graph has no inputs for sources that no view reads, so its inputs are to be given by name.
    """

    def __init__(self, plan: RenderPlan) -> None:
        super().__init__()
        self.plan = plan

    def forward(self, *images: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(view[0] for view in render_torch(self.plan, [image[None] for image in images]))

    @property
    def example(self) -> tuple[torch.Tensor, ...]:
        """Images of the plan's sizes."""
        return tuple(torch.zeros(3, *size, dtype=torch.uint8) for size in self.plan.source.sizes)


def _write_arrays(plan: RenderPlan, file: BinaryIO) -> None:
    np.savez_compressed(file, **plan_arrays(plan))


def _write_torchscript(plan: RenderPlan, file: BinaryIO) -> None:
    module = PlanModule(plan).eval()
    torch.jit.save(torch.jit.trace(module, module.example, check_trace=False), file)


def _write_onnx(plan: RenderPlan, file: BinaryIO) -> None:
    optional_package("onnx", "export")
    module, graph, ending = PlanModule(plan).eval(), BytesIO(), "_view"
    while {f"{name}{ending}" for name in plan.target.names} & {*plan.source.names}:
        ending += "_view"  # inputs and outputs share their names in a graph
    torch.onnx.export(
        module,
        module.example,
        graph,  # type: ignore[arg-type]  # allowed where dynamo is False
        dynamo=False,
        opset_version=_OPSET,
        input_names=list(plan.source.names),
        output_names=[f"{name}{ending}" for name in plan.target.names],
    )
    file.write(graph.getbuffer())


_WRITERS: dict[str, Callable[[RenderPlan, BinaryIO], None]] = {
    ".npz": _write_arrays,
    ".onnx": _write_onnx,
    ".pt": _write_torchscript,
}
