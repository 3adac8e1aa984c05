"""``show``: a sample's images as a figure."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from arbiview_aug import RigRetarget, SampleError, collate, project_boxes_3d, show
from tests.helpers import street_sample


def pictures(sample: object) -> list[np.ndarray]:
    return [np.asarray(axes.images[0].get_array()) for axes in show(sample).axes if axes.images]


def test_images_are_drawn_with_boxes_under_their_cameras_names() -> None:
    sample = street_sample()
    figure = show(sample)
    assert [axes.get_title() for axes in figure.axes] == sample["rig"].names
    shown = zip(pictures(sample), sample["images"], strict=True)
    drawn = [bool((picture != image.permute(1, 2, 0).numpy()).any()) for picture, image in shown]
    labelled = [len(boxes.rows) > 0 for boxes in project_boxes_3d(sample["boxes_3d"], sample["rig"])]
    assert drawn == labelled and any(labelled)
    assert figure._repr_png_().startswith(b"\x89PNG")


def test_bfloat16_images() -> None:
    sample = street_sample()
    halves = sample | {"images": (sample["images"].float() / 255).to(torch.bfloat16)}
    for one, other in zip(pictures(sample), pictures(halves), strict=True):
        assert np.abs(one.astype(float) - other).max() <= 1


def test_what_no_camera_saw_is_dimmed() -> None:
    sample = street_sample()
    del sample["boxes_3d"]
    views = RigRetarget(sample["rig"].turned(pitch_deg=-10), geometry="street")(sample)
    for picture, image, seen in zip(pictures(views), views["images"], views["coverage"].numpy(), strict=True):
        image = image.permute(1, 2, 0).numpy()
        assert not seen.all() and (picture[seen] == image[seen]).all()
        assert picture[~seen].mean() < 0.5 * image[~seen].mean()


def test_batches_show_each_frame() -> None:
    sample = {key: value for key, value in street_sample().items() if key in ("images", "K", "cam2ego", "boxes_3d")}
    titles = [axes.get_title() for axes in show(collate([sample, sample])).axes]
    assert titles == [f"frame {k}, camera {j}" for k in range(2) for j in range(6)]


def test_mistakes_are_those_of_retargeting() -> None:
    with pytest.raises(SampleError, match="'K' and 'cam2ego', missing K, cam2ego"):
        show({"images": torch.zeros(1, 3, 4, 4, dtype=torch.uint8)})
