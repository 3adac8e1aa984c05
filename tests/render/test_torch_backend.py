"""Parts of the torch execution against values by hand; ``test_backends`` compares whole views with OpenCV's."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from arbiview_aug.render.plan import AtlasLayout, FixedMap, Slot
from arbiview_aug.render.torch_backend import _blend, _blended, _fill_atlas, _grid, _sample, _toned

CPU = torch.device("cpu")


@pytest.mark.parametrize("size", [(5, 7), (1, 7), (1, 1)])
def test_a_grid_of_pixel_centres_reads_the_atlas(size: tuple[int, int]) -> None:
    atlas = torch.rand(2, 3, *size)
    uv = np.stack(np.meshgrid(np.arange(size[1]), np.arange(size[0])), -1).astype(np.float32)
    for interpolation in ("nearest", "linear", "cubic"):
        torch.testing.assert_close(_sample(atlas, _grid(uv, size, CPU), interpolation), atlas, atol=1e-5, rtol=0)


def test_between_pixels_and_outside() -> None:
    atlas = torch.tensor([[0.0, 4.0], [8.0, 16.0]]).expand(1, 3, 2, 2)
    uv = np.array([[[0.5, 0.0], [0.5, 0.5], [-16.0, -16.0]]], np.float32)
    assert _sample(atlas, _grid(uv, (2, 2), CPU), "linear")[0, 0].tolist() == [pytest.approx([2, 7, 0], abs=1e-5)]


@pytest.mark.parametrize(("dtype", "halved"), [(torch.uint8, 3.0), (torch.float32, 2.5)])
def test_images_lie_in_their_slots_halved_as_asked(dtype: torch.dtype, halved: float) -> None:
    """uint8 is rounded as OpenCV rounds it: 2.5 becomes 3. Gaps are zero."""
    layout = AtlasLayout((Slot(0, 0, 0, 0, (2, 4)), Slot(1, 1, 0, 4, (1, 2))))
    image = torch.tensor([[1, 2, 1, 2], [3, 4, 3, 4]], dtype=dtype).expand(1, 3, 2, 4)
    atlas = _fill_atlas(layout, [image, image])
    assert atlas.dtype == torch.float32 and tuple(atlas.shape[2:]) == layout.size
    assert torch.equal(atlas[..., :4], image.float())
    assert (atlas[:, :, 0, 4:6] == halved).all() and not atlas[:, :, 1, 4:].any()
    beside = _fill_atlas(AtlasLayout((Slot(1, 0, 0, 3, (2, 4)),)), [image, image])  # none is read at column 0
    assert torch.equal(beside, torch.nn.functional.pad(image.float(), (3, 0)))
    assert _fill_atlas(AtlasLayout(()), [image]).tolist() == [[[[0]]] * 3]


def test_curves_brighten_and_darken_up_to_the_ends_of_the_range() -> None:
    """The lower of gain·v and slope·v + top·(1 − slope) for gains above 1, else the higher; 1 changes nothing."""
    view = torch.tensor([100.0, 200.0, 100.0, 200.0, 77.0, 77.0]).expand(1, 3, 6)
    source = torch.tensor([0, 0, 1, 1, 2, -1])
    curves, row = torch.tensor([[[1.5, 0.5], [0.5, 1.5], [1.0, 1.0]]])[:, :, None], torch.arange(6)
    assert _toned(view, source, row, curves, 255)[0, 0].tolist() == [150, 228, 50, 173, 77, 77]
    toned = _toned(view / 255, source, row, curves, 1)[0, 0] * 255
    assert toned.tolist() == pytest.approx([150, 227.5, 50, 172.5, 77, 77], abs=1e-3)


def test_bands_become_pixels_of_the_flattened_view() -> None:
    at = FixedMap(np.array([[[0, 0], [1, 0]]], np.int16), np.zeros((1, 2), np.uint16))
    bands = [
        SimpleNamespace(y=2, x=1, source=3, at=at, weight=np.array([[0.0, 0.5]], np.float32)),
        SimpleNamespace(y=0, x=0, source=1, at=at, weight=np.array([[0.25, 0.0]], np.float32)),
    ]
    blend = _blend(SimpleNamespace(bands=bands, source_camera=np.zeros((3, 4), np.int8)), (1, 2), CPU)
    assert blend is not None
    assert (blend.pixel.tolist(), blend.weight.tolist(), blend.source.tolist()) == ([10, 0], [0.5, 0.25], [3, 1])
    atlas, change = torch.tensor([[[[40.0, 80.0]]]]).expand(1, 3, 1, 2), torch.zeros(1, 3, 4)
    view = _blended(torch.full((1, 3, 3, 4), 20.0), atlas, blend, "linear", None, change)
    assert view[0, 0].flatten()[[10, 0, 5]].tolist() == pytest.approx([50, 25, 20])
    assert change.flatten()[[10, 0, 5]].tolist() == pytest.approx([30, 5, 0])  # the difference times the share
