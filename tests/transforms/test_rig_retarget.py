"""``RigRetarget``'s sample contract: what goes in, what comes out, what stays and what is refused."""

from __future__ import annotations

import copy
import pickle
import warnings
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import default_collate

from arbiview_aug import RandomRig, Rig, RigRetarget, SampleError, SampleKeys, SampleTypeError
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.inpaint import Telea
from arbiview_aug.render.plan import RenderConfig
from tests import helpers
from tests.helpers import same, sample_of, smooth_images

SIZE = (36, 64)
EXECUTIONS = ["opencv", "torch"]


@pytest.fixture(autouse=True)
def no_warnings() -> Iterator[None]:
    """A warning that no test expects is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        warnings.filterwarnings("ignore", "target cameras stand up to")
        yield


def ring(count: int = 4, size: tuple[int, int] = SIZE, **changes: Any) -> Rig:
    """Cameras all around with overlaps, 1.5 m above the road."""
    return Rig(helpers.ring(count, size=size, horizontal_fov_deg=360 / count + 30).cameras, name="ring", **changes)


def with_mask(rig: Rig) -> Rig:
    """The bottom rows of the first camera show the own car."""
    mask = np.ones(rig[0].size, bool)
    mask[-6:] = False
    cameras = [replace(c, mask=mask) if k == 0 else c for k, c in enumerate(rig)]
    return rig.with_cameras(cameras)


def with_lens(rig: Rig, lens: str = "radtan") -> Rig:
    coefficients = (-0.1, 0.01, 0.001, -0.001, 0.0) if lens == "radtan" else (-0.02, 0.003, 0.0, 0.0)
    cameras = [replace(c, lens=lens, distortion=coefficients) if k % 2 == 0 else c for k, c in enumerate(rig)]
    return rig.with_cameras(cameras)


# --- images and calibration -------------------------------------------------------------------------------------------
@pytest.mark.parametrize("execution", EXECUTIONS)
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32, torch.float16, torch.float64])
def test_the_output(dtype: torch.dtype, execution: str) -> None:
    source, target = ring(), ring(5, (30, 50)).turned(yaw_deg=20)
    out = RigRetarget(target, backend=execution)(sample_of(source, dtype))
    assert list(out) == ["images", "K", "cam2ego", "ground_z_m", "coverage", "generated"]
    assert out["images"].shape == (5, 3, 30, 50) and out["images"].dtype == dtype
    assert out["coverage"].shape == (5, 30, 50) and out["coverage"].dtype == torch.bool
    assert out["coverage"].float().mean() > 0.8
    np.testing.assert_array_equal(out["K"], target.K)
    np.testing.assert_array_equal(out["cam2ego"], target.cam2ego)
    assert out["generated"].any() and torch.equal(out["generated"], ~out["coverage"])


def test_mixed_target_sizes_give_lists_unless_a_size_is_asked_for() -> None:
    base = ring()
    target = base.with_cameras([base[0].resize((18, 32)), *base.cameras[1:]])
    out = RigRetarget(target, keys=SampleKeys(extra=("source_camera",)))(sample_of(base))
    sizes = [(18, 32), SIZE, SIZE, SIZE]
    for key, shape in (("images", (3,)), ("coverage", ()), ("source_camera", ())):
        assert isinstance(out[key], list) and [tuple(v.shape) for v in out[key]] == [(*shape, *s) for s in sizes]
    assert out["source_camera"][0].dtype == torch.int8
    out = RigRetarget(target, size=(24, 40))(sample_of(base))
    assert out["images"].shape == (4, 3, 24, 40)
    np.testing.assert_array_equal(out["K"], target.resized((24, 40), "crop").K)


def test_calibration_follows_the_inputs_dtype() -> None:
    source, retarget = ring(), RigRetarget(ring(5))
    sample = sample_of(source)
    sample["K"], sample["cam2ego"] = sample["K"].float(), sample["cam2ego"].half().double()
    sample["cam2ego"] = torch.from_numpy(source.cam2ego)
    out = retarget(sample)
    assert out["K"].dtype == torch.float32 and out["cam2ego"].dtype == torch.float64
    whole = {**sample_of(source), "K": torch.from_numpy(source.K).round().long()}
    assert retarget(whole)["K"].dtype == torch.float64  # whole numbers would cut the target's
    bare = {"images": sample["images"], "rig": source}
    assert retarget(bare)["K"].dtype == torch.float64


def test_the_rig_wins_and_is_consumed() -> None:
    source, retarget = ring(), RigRetarget(ring().turned(yaw_deg=10))
    expected = retarget(sample_of(source))
    wrong = source.turned(yaw_deg=90)
    out = retarget({**sample_of(wrong), "images": smooth_images(source), "rig": source})
    assert "rig" not in out and same(out["images"], expected["images"])
    by_constructor = RigRetarget(ring().turned(yaw_deg=10), source=source)({"images": smooth_images(source)})
    assert same(by_constructor["images"], expected["images"])
    both = RigRetarget(ring().turned(yaw_deg=10), source=wrong)({"images": smooth_images(source), "rig": source})
    assert same(both["images"], expected["images"])


@pytest.mark.parametrize("lens", ["radtan", "fisheye"])
def test_lens_targets_and_retargeting_again(lens: str) -> None:
    source, target = ring(), with_lens(ring(), lens)
    out = RigRetarget(target)(sample_of(source))
    assert out["lens"] == [lens, "pinhole", lens, "pinhole"]
    assert out["distortion"].shape == (4, 8) and out["distortion"].dtype == torch.float64
    assert tuple(out["distortion"][0, : len(target[0].distortion)].tolist()) == target[0].distortion
    assert not out["distortion"][1].any()

    back = RigRetarget(source)(out)
    assert "lens" not in back and "distortion" not in back
    error = (back["images"].int() - sample_of(source)["images"].int()).abs().movedim(1, -1)
    middle = (slice(None), slice(6, -6), slice(12, -12))  # neighbours show other things there
    assert back["coverage"][middle].all() and error[middle].float().mean() < 2

    collated = default_collate([out, out])
    again = RigRetarget(source)(collated)
    assert same(again["images"], torch.stack([back["images"]] * 2))


def lenses_of(rig: Rig) -> list[str]:
    return [camera.lens for camera in rig]


# --- other entries ----------------------------------------------------------------------------------------------------
def test_other_entries_are_the_same_objects_and_the_input_stays() -> None:
    source = ring()
    others = {
        "token": "abc",
        "points": torch.rand(10, 4),
        "boxes_3d": torch.rand(2, 7),
        "anything": {"nested": [1, 2]},
        "odd": object(),
    }
    sample = {**others, **sample_of(source), "rig": source}
    before = dict(sample)
    images = sample["images"].clone()
    out = RigRetarget(ring(5, (20, 40)))(sample)
    assert all(out[key] is value for key, value in others.items())
    assert sample.keys() == before.keys() and all(sample[key] is before[key] for key in sample)
    assert torch.equal(sample["images"], images)
    assert list(out)[:5] == list(others)  # order kept


def test_pixel_bound_keys_are_dropped_with_one_warning() -> None:
    source, retarget = ring(), RigRetarget(ring().turned(yaw_deg=3))
    matrices = {key: torch.eye(4).expand(4, 4, 4) for key in ("lidar2img", "extrinsics")}
    sample = sample_of(source, boxes_2d=torch.rand(3, 4), depth=torch.rand(4, *SIZE), neighbours=[], **matrices)
    sample["depth_m"] = torch.ones(4, *SIZE)  # read, and dropped without a word
    with pytest.warns(UserWarning, match="drops boxes_2d, depth, lidar2img, extrinsics: they speak of the source's"):
        out = retarget(sample)
    assert not {"boxes_2d", "depth", "depth_m", "neighbours", *matrices} & set(out)
    retarget(sample)  # without a second warning


def test_pixel_bound_keys_can_be_kept_or_rendered() -> None:
    source = ring()
    sample = sample_of(source, boxes_2d=torch.rand(3, 4), confidence=torch.rand(4, *SIZE))
    out = RigRetarget(source, keys=SampleKeys(keep=["boxes_2d"], labels=["confidence"], ignore_index=0))(sample)
    assert out["boxes_2d"] is sample["boxes_2d"]
    used = {"neighbours": [], "motion_depth_words": "none", "coverage": torch.ones((4, *SIZE)) > 0}
    kept = RigRetarget(source.turned(yaw_deg=5), keys=SampleKeys(keep=tuple(used)))(sample_of(source, **used))
    assert kept["neighbours"] == [] and kept["motion_depth_words"] == "none"
    assert not kept["coverage"].all()  # the output's own
    with pytest.raises(ValueError, match=r"SampleKeys.labels: expected keys of label maps, got coverage, images"):
        SampleKeys(labels=("images", "seg", "coverage"))
    with pytest.raises(ValueError, match=r"SampleKeys.keep: expected no calibration of the source's, got lens, rig"):
        SampleKeys(keep=("rig", "lens"))
    inner = (slice(None), slice(2, -2), slice(2, -2))
    assert torch.equal(out["confidence"][inner], sample["confidence"][inner])


@pytest.mark.parametrize(
    "key",
    [
        *("ego2cam", "cam2global", "cam2lidar", "world2cam", "P", "P2", "proj_mat", "projection", "projection_matrix"),
        *("dist_coeffs", "distortions", "post_rots", "post_trans", "img_aug_matrix", "img_metas", "img_filename"),
        *("gt_depth", "gt_bboxes", "gt_bboxes_2d", "bboxes2d", "boxes2d", "centers2d", "labels2d"),
    ],
)
def test_other_names_of_stale_keys_are_dropped(key: str) -> None:
    sample = sample_of(ring(), **{key: [1]}, D=[1], uv=[1], lidar2ego=[1], cam_names=["a"])
    with pytest.warns(UserWarning, match=f"drops {key}: they speak of the source's pixels or cameras"):
        out = RigRetarget(ring().turned(yaw_deg=3), source=ring())(sample)
    assert {"D", "uv", "lidar2ego", "cam_names"} <= out.keys() and key not in out
    keep = SampleKeys(keep=[key])
    assert RigRetarget(ring().turned(yaw_deg=3), source=ring(), keys=keep)(sample)[key] is sample[key]


MAPS = torch.zeros((4, *SIZE), dtype=torch.uint8)
OF_A_CAMERA = "depth depth_m gt_depth depth_map Depth_GT depthmap disparity optical_flow normals".split()
IMAGES = torch.zeros((4, 3, *SIZE), dtype=torch.uint8)
OTHER = r"drop the key, .*SampleKeys\(keep=.*label maps .*SampleKeys\(labels=.*'neighbours'.*Several frames"
STALE: list[tuple[str, Any, str]] = [  # key, value, and what is said of it
    *(("parts", np.zeros(shape), OTHER) for shape in (SIZE, (4, *SIZE), (4, 2, *SIZE), (4, *SIZE, 2))),
    *(("parts", [{"parts": torch.zeros(shape)}], OTHER) for shape in (SIZE, (4, *SIZE), (4, *SIZE, 2))),
    ("flow", np.zeros((4, *SIZE)), r"drop the key, .*SampleKeys\(keep=\('flow',\)\); depth, .* other cameras"),
    ("sweeps", [{"images": IMAGES}], OTHER),
    ("cams", {"front": {"img": IMAGES[0]}}, OTHER),
    ("sweep_arrays", [{"images": IMAGES.numpy()}], OTHER),
    ("previous_list", list(IMAGES), OTHER),
]


@pytest.mark.parametrize(("key", "value", "message"), STALE)
def test_what_is_bound_to_the_sources_pixels_is_refused(key: str, value: Any, message: str) -> None:
    sample = sample_of(ring(), **{key: value})
    with pytest.raises(SampleError, match=f"{key}: shape .*{message}"):
        RigRetarget(ring())(sample)
    assert RigRetarget(ring(), keys=SampleKeys(keep=[key]))(sample)[key] is value


@pytest.mark.parametrize("key", OF_A_CAMERA)
def test_values_that_depend_on_the_camera_are_no_label_maps(key: str) -> None:
    refused = rf"labels: expected keys of label maps, got {key}: depth, .* cameras; drop .* depth_maps\(points, views"
    with pytest.raises(SampleError, match=refused):
        RigRetarget(ring(), keys=SampleKeys(labels=("seg", key)))


@pytest.mark.parametrize("key", ["depth_mask", "flow_valid", "depth_bins", "overflow", "normal_vehicles"])
def test_label_maps_beside_depth_are_rendered(key: str) -> None:
    assert key in RigRetarget(ring(), keys=SampleKeys(labels=(key,)))(sample_of(ring(), **{key: MAPS}))


def test_stale_tensors_of_torchvision_are_refused() -> None:
    tv_tensors = pytest.importorskip("torchvision.tv_tensors")
    boxes = tv_tensors.BoundingBoxes(torch.rand(2, 4), format="XYXY", canvas_size=SIZE)
    stale = r"target: a tv_tensors.Bound.* SampleKeys\(keep=\('target',\)\)"
    flow = "labels: expected keys of label maps, got gt_flow"
    for key, value, message in (
        ("target", boxes, stale),
        ("target", {"boxes": boxes}, stale),
        ("gt_flow", tv_tensors.Mask(MAPS), flow),
    ):
        with pytest.raises(SampleError, match=message):
            RigRetarget(ring())(sample_of(ring(), **{key: value}))
        assert RigRetarget(ring(), keys=SampleKeys(keep=[key]))(sample_of(ring(), **{key: value}))[key] is value


# --- label maps -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.float32, torch.bool])
def test_label_maps_are_the_winning_sources(dtype: torch.dtype) -> None:
    source, target = ring(), ring().turned(yaw_deg=30)
    values = torch.arange(4)[:, None, None].expand(4, *SIZE).to(dtype).contiguous()
    retarget = RigRetarget(target, keys=SampleKeys(labels=["classes"], ignore_index=77, extra=["source_camera"]))
    out = retarget(sample_of(source, classes=values))
    assert out["classes"].dtype == dtype and out["classes"].shape == (4, *SIZE)
    fill = torch.tensor(0 if dtype == torch.bool else 77, dtype=dtype)
    expected = torch.where(out["coverage"], out["source_camera"].to(dtype), fill)
    assert torch.equal(out["classes"], expected)


def test_labels_of_pixels_that_were_filled_anew_are_ignored() -> None:
    source = ring()
    sample = sample_of(source, seg=torch.ones((4, *SIZE), dtype=torch.int64))
    keys = SampleKeys(labels=("seg",))
    out = RigRetarget(source.shifted(z_m=0.7), holes=Telea(min_confidence=0.5), geometry="street", keys=keys)(sample)
    assert torch.equal(out["seg"] == 1, out["coverage"]) and out["coverage"].any()
    assert (out["seg"][out["generated"]] == 255).all()


NAN = float("nan")
UNFIT: list[tuple[Any, float, str]] = [  # label maps, the value of uncovered pixels, and what is said of them
    (MAPS[:3], 255, "classes: expected 4 label maps, one an image, got 3"),
    (MAPS.mT, 255, r"classes: camera 'camera 0': expected a map of \(h, w\) = \(36, 64\), got"),
    (MAPS.to(torch.int8), 255, r"classes: SampleKeys.ignore_index: expected a value of torch.int8, got 255; give"),
    (MAPS.int(), NAN, r"classes: SampleKeys.ignore_index: expected .* torch.int32, got nan"),
    (MAPS.half(), 1e5, r"classes: SampleKeys.ignore_index: expected .* torch.float16, got 100000"),
    (MAPS.half(), NAN, ""),
    (MAPS.to(torch.int8), -1, ""),
    (torch.tensor(3), 255, r"classes: expected label maps of shape \(..., N, H, W\), got \(\)"),
    (
        [MAPS[:k].bool() for k in range(1, 5)],
        255,
        r"'camera 1': expected .*torch.bool', 1, 'H', .*, got .*2, .*; m",
    ),
    (MAPS.numpy(), 255, "classes: expected label maps as tensors, got ndarray"),
    (MAPS.to(torch.uint16), 255, r"classes: expected uint8 or .*torch.uint16; use .to\(torch.int32\)"),
]


@pytest.mark.parametrize(("value", "fill", "message"), UNFIT)
def test_label_maps_that_do_not_fit(value: Any, fill: float, message: str) -> None:
    retarget = RigRetarget(ring(), keys=SampleKeys(labels=["classes"], ignore_index=fill))
    with pytest.raises((SampleError, SampleTypeError), match=message) if message else nullcontext():
        retarget(sample_of(ring(), classes=value))
    with pytest.raises(SampleError, match=r"SampleKeys.labels: expected classes in the sample, got images, K, cam2ego"):
        retarget(sample_of(ring()))


# --- torchvision ------------------------------------------------------------------------------------------------------
def test_tv_tensors_are_wrapped_again() -> None:
    tv_tensors = pytest.importorskip("torchvision.tv_tensors")
    source = ring()
    sample = sample_of(source)
    mask = tv_tensors.Mask(torch.arange(4, dtype=torch.uint8)[:, None, None].expand(4, *SIZE))
    wrapped = {**sample, "images": tv_tensors.Image(sample["images"]), "classes": mask}
    retarget = RigRetarget(source.turned(yaw_deg=10), keys=SampleKeys(extra=["source_camera"]))
    out, plain = retarget(wrapped), retarget(sample)
    assert type(out["images"]) is tv_tensors.Image and type(out["classes"]) is tv_tensors.Mask
    assert type(out["coverage"]) is torch.Tensor
    assert torch.equal(out["images"].as_subclass(torch.Tensor), plain["images"])
    covered = out["coverage"]
    assert torch.equal(out["classes"].as_subclass(torch.Tensor)[covered], out["source_camera"][covered].to(torch.uint8))
    lists = {**sample, "images": [tv_tensors.Image(image) for image in sample["images"]]}
    assert type(retarget(lists)["images"]) is tv_tensors.Image


# --- batches ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("execution", EXECUTIONS)
@pytest.mark.parametrize("lead", [(2,), (1, 2)])
def test_leading_dimensions_equal_the_single_calls(lead: tuple[int, ...], execution: str) -> None:
    rigs = [with_lens(ring()), with_lens(ring()).shifted(x_m=0.4).turned(yaw_deg=7)]  # a calibration each
    labels = [torch.randint(0, 9, (4, *SIZE), generator=torch.Generator().manual_seed(k)) for k in range(2)]
    target = with_mask(with_lens(ring(3, (20, 40), ground_z_m=-0.33)))
    retarget = RigRetarget(
        target, backend=execution, keys=SampleKeys(labels=["classes"], extra=["source_camera"], frame="target")
    )
    singles = []
    for k, rig in enumerate(rigs):
        distortion = torch.zeros(4, 8, dtype=torch.float64)
        for row, camera in zip(distortion, rig, strict=True):
            row[: len(camera.distortion)] = torch.tensor(camera.distortion)
        lens = [camera.lens for camera in rig]
        more = {"distortion": distortion, "lens": lens, "ground_z_m": 0.1 * k, "points": torch.rand(5, 4)}
        singles.append({**sample_of(rig, seed=k), **more, "ego2world": torch.eye(4).double(), "classes": labels[k]})
    batch = default_collate(singles)
    batch["lens"] = singles[0]["lens"]
    for key, value in batch.items():
        if isinstance(value, torch.Tensor):
            batch[key] = value.reshape(*lead, *value.shape[1:])
    out = retarget(batch)
    expected = default_collate([retarget(single) for single in singles])
    assert set(out) == set(expected)
    for key, value in expected.items():
        if isinstance(value, torch.Tensor):
            assert same(out[key], value.reshape(*lead, *value.shape[1:])), key
    assert out["lens"] == [camera.lens for camera in target]


def test_a_batch_of_lists() -> None:
    base = ring()
    source = base.with_cameras([base[0].resize((18, 32)), *base.cameras[1:]])
    target = base.with_cameras([*base.cameras[:3], base[3].resize((18, 32))])
    singles = [{**sample_of(source, seed=k), "classes": smooth_images(source, seed=k)} for k in range(2)]
    for single in singles:
        single["classes"] = [image[0] for image in single["classes"]]
    retarget = RigRetarget(target, keys=SampleKeys(labels=["classes"]))
    out, expected = retarget(default_collate(singles)), default_collate([retarget(single) for single in singles])
    for key in ("images", "coverage", "classes"):
        assert isinstance(out[key], list) and same(out[key], expected[key])


# --- skipping ---------------------------------------------------------------------------------------------------------
def test_skipping_needs_a_size_and_equal_counts() -> None:
    with pytest.raises(ValueError, match=r"p < 1: expected size=\(h, w\)"):
        RigRetarget(ring(), p=0.5)
    wanted = r"p < 1: expected the target to have the source's 4 cameras, got 5.*arbiview_aug\.MixedDataset"
    with pytest.raises(SampleError, match=wanted):
        RigRetarget(ring(5), p=0.5, size=SIZE)(sample_of(ring()))


@pytest.mark.parametrize("lensed", ["neither", "source", "target"])
@pytest.mark.parametrize("masked", ["neither", "source", "target"])
def test_skipped_samples_collate_with_retargeted_ones(masked: str, lensed: str) -> None:
    source, target = ring(), ring().turned(yaw_deg=20)
    if lensed != "neither":
        source, target = (with_lens(source), target) if lensed == "source" else (source, with_lens(target))
    if masked != "neither":
        source, target = (with_mask(source), target) if masked == "source" else (source, with_mask(target))
    sample = {"images": smooth_images(source), "rig": source, "classes": torch.ones((4, *SIZE), dtype=torch.uint8)}
    retarget = RigRetarget(target, p=0.5, size=(18, 32), keys=SampleKeys(labels=["classes"], extra=["source_camera"]))
    outs = {flag: retarget(sample, params={"skipped": flag}) for flag in (0.0, 1.0)}
    assert list(outs[0.0]) == list(outs[1.0])
    assert outs[0.0]["lens"] == lenses_of(target) and outs[1.0]["lens"] == lenses_of(source)
    batch = default_collate(list(outs.values()))
    assert batch["images"].shape == (2, 4, 3, 18, 32) and batch["classes"].shape == (2, 4, 18, 32)
    skipped = outs[1.0]
    assert skipped["coverage"].all() and (skipped["classes"] == 1).all()
    np.testing.assert_array_equal(skipped["K"], source.resized((18, 32)).K)
    np.testing.assert_array_equal(skipped["cam2ego"], source.cam2ego)
    if masked != "target":
        assert not outs[0.0]["ego_mask"].any()
    if masked == "target":
        np.testing.assert_array_equal(outs[0.0]["ego_mask"][0], ~target.resized((18, 32))[0].mask)
    if masked == "source":
        np.testing.assert_array_equal(skipped["ego_mask"][0], ~source.resized((18, 32))[0].mask)


def test_a_skipped_sample_is_the_resized_source_in_memory_of_its_own() -> None:
    source = ring()
    sample = sample_of(source)
    before = sample["images"].clone()
    out = RigRetarget(source, p=0.0, size=SIZE)(sample)
    assert torch.equal(out["images"], before)
    out["images"].zero_()
    assert torch.equal(sample["images"], before)
    half = RigRetarget(source, p=0.0, size=(18, 32))(sample)["images"].float()
    expected = before.float().reshape(4, 3, 18, 2, 32, 2).mean((3, 5))
    assert (half - expected).abs().max() <= 1


def test_p_is_the_share_of_retargeted_samples() -> None:
    source = ring(4, (4, 6))
    retarget = RigRetarget(source, p=0.7, size=(4, 6))
    retarget.set_epoch(1)  # without effect: the target is fixed
    torch.manual_seed(0)
    skipped = [retarget(sample_of(source))["retarget_params"]["skipped"] for _ in range(300)]
    assert set(skipped) == {0.0, 1.0} and 0.2 < np.mean(skipped) < 0.4


# --- draws ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("p", [1.0, 0.5])
def test_replay_is_bit_identical(p: float) -> None:
    source = ring()
    retarget = RigRetarget(RandomRig(ring(), yaw_deg=15, height_m=0.3, focal_scale=0.1), p=p, size=SIZE)
    torch.manual_seed(0)
    for _ in range(4):
        out = retarget(sample_of(source))
        assert all(isinstance(value, float) for value in out["retarget_params"].values())
        assert same(retarget(sample_of(source), params=out["retarget_params"]), out)
        batch = default_collate([out, out])  # numbers from a collated batch
        params = {name: value[1] for name, value in batch["retarget_params"].items()}
        assert same(retarget(sample_of(source), params=params), out)


def test_parameters_of_an_earlier_retargeting_do_not_linger() -> None:
    source = ring()
    first = RigRetarget(RandomRig(ring(), yaw_deg=5))(sample_of(source))
    assert "retarget_params" not in RigRetarget(ring())(first)
    with pytest.raises(SampleError, match="params: expected none for a fixed target rig, got yaw_deg"):
        RigRetarget(ring())(sample_of(source), params={"yaw_deg": 3.0})


def test_rigs_drawn_for_each_sample_do_not_fill_the_cache() -> None:
    retarget = RigRetarget(RandomRig(ring(), yaw_deg=15))
    for _ in range(3):
        retarget(sample_of(ring()))
    assert len(retarget.renderer.plans) == 1


# --- frames of reference ----------------------------------------------------------------------------------------------
def test_convention_labels_in_the_targets_frame() -> None:
    """An AV2-like target: its origin, the rear axle, is 0.33 m above its road; the source's is on the road."""
    source, target = ring(), ring(3, ground_z_m=-0.33)
    points, boxes = torch.rand(10, 4), torch.rand(2, 9).double()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([100.0, 50.0, 2.0])
    sample = sample_of(source, points=points, boxes_3d=boxes, ego2world=pose)
    heights = [c.center_m[2] - target.ground_z_m for c in target]  # 1.83 m above the road

    here = RigRetarget(target)(sample)
    np.testing.assert_allclose(here["cam2ego"][:, 2, 3], heights)  # the source's road is at 0
    assert here["points"] is points and here["ego2world"] is pose and here["ground_z_m"] == 0
    assert "ego2ego" not in here

    there = RigRetarget(target, keys=SampleKeys(frame="target"))(sample)
    np.testing.assert_allclose(there["cam2ego"], target.cam2ego)
    np.testing.assert_allclose(there["cam2ego"][:, 2, 3] - there["ground_z_m"], heights)
    assert there["ground_z_m"] == -0.33
    expected = torch.eye(4, dtype=torch.float64)
    expected[2, 3] = -0.33  # what lies on the road is 0.33 m below the target's origin
    assert torch.equal(there["ego2ego"], expected)
    np.testing.assert_allclose(there["points"][:, 2], points[:, 2] - 0.33, atol=1e-6)
    np.testing.assert_array_equal(there["points"][:, [0, 1, 3]], points[:, [0, 1, 3]])
    np.testing.assert_allclose(there["boxes_3d"][:, 2], boxes[:, 2] - 0.33)
    np.testing.assert_array_equal(there["boxes_3d"][:, 3:], boxes[:, 3:])
    # A point keeps its place in the world.
    p_here, p_there = (torch.cat([s["points"][0, :3].double(), torch.ones(1)]) for s in (here, there))
    np.testing.assert_allclose(there["ego2world"] @ p_there, pose @ p_here, atol=1e-6)
    assert torch.equal(there["images"], here["images"])


@pytest.mark.parametrize("container", ["list", "array", "big-endian array"])
def test_points_in_lists_and_arrays_move_too(container: str) -> None:
    source, retarget = ring(), RigRetarget(ring(ground_z_m=-0.5), keys=SampleKeys(frame="target"))
    points = torch.rand(6, 3)
    moving: Any = [points, points[:2]] if container == "list" else points.numpy()
    sample = default_collate([sample_of(source)] * 2) if container == "list" else sample_of(source)
    out = retarget({**sample, "points": moving})["points"]
    moved = points - torch.tensor([0, 0, 0.5])
    if container == "big-endian array":
        swapped = retarget({**sample, "points": points.numpy().astype(">f4")})["points"]
        np.testing.assert_array_equal(swapped, out)
    if container == "list":
        assert len(out) == 2 and torch.equal(out[0], moved) and torch.equal(out[1], moved[:2])
    else:
        np.testing.assert_array_equal(out, moved)


@pytest.mark.parametrize(
    ("geometry", "entry", "message"),
    [
        ("auto", {"boxes_3d": "none"}, "boxes_3d: expected a tensor of numbers, got str"),
        ("street", {"boxes_3d": "none"}, "boxes_3d: SampleKeys.frame='target': expected a float tensor, got str"),
        ("street", {"points": torch.zeros(3, 3).long()}, "points: .*expected a float tensor, got torch.int64"),
        ("street", {"ego2world": np.eye(4).tolist()}, "ego2world: .*expected a float tensor, got list"),
    ],
)
def test_labels_that_cannot_move(geometry: Any, entry: dict[str, Any], message: str) -> None:
    retarget = RigRetarget(ring(ground_z_m=-0.5), keys=SampleKeys(frame="target"), geometry=geometry)
    with pytest.raises(SampleTypeError, match=message):
        retarget(sample_of(ring(), **entry))
    with pytest.raises(SampleError, match=r"points: expected .*\(2.*, got .*\(7, 3\)"):
        retarget({**default_collate([sample_of(ring())] * 2), "points": torch.zeros(7, 3)})


# --- the transform as an object ---------------------------------------------------------------------------------------
def test_copies_and_pickles() -> None:
    retarget = RigRetarget(RandomRig(ring(), yaw_deg=5), size=SIZE)
    sample = sample_of(ring())
    torch.manual_seed(1)
    expected = copy.deepcopy(retarget)(sample)
    retarget(sample)
    for other in (copy.deepcopy(retarget), pickle.loads(pickle.dumps(retarget))):
        assert len(other.renderer.plans) == 0
        torch.manual_seed(1)
        assert same(other(sample), expected)
    fixed = RigRetarget("waymo", size=SIZE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fixed(sample)
        assert same(pickle.loads(pickle.dumps(fixed))(sample), fixed(sample))
    assert len(pickle.dumps(fixed)) < 20_000  # plans stay behind


def test_repr_says_what_it_does() -> None:
    text = repr(RigRetarget("waymo", size=(256, 704), p=0.5))
    assert all(part in text for part in ("RigRetarget", "waymo", "auto", "(256, 704)", "p=0.5", "RenderConfig"))
    assert "yaw_deg -5..5" in repr(RigRetarget(RandomRig("waymo", yaw_deg=5)))
    assert "unnamed" in repr(RigRetarget(Rig(ring().cameras)))


def test_prepare_builds_the_plan_that_samples_use() -> None:
    source = ring()
    retarget = RigRetarget(ring().turned(yaw_deg=5), source=source, size=(18, 32))
    retarget.prepare()
    retarget({"images": smooth_images(source)})
    retarget({"images": smooth_images(source), "rig": ring()})  # an equal rig
    assert retarget.renderer.plans.misses == 1
    assert RigRetarget("waymo", geometry="street").prepare("nuscenes").source.name == "nuscenes"
    for bad in (RigRetarget(ring()), RigRetarget(RandomRig(ring()), source=source)):
        with pytest.raises(ValueError, match=r"prepare: expected a source rig .*, got (no|a) source and a"):
            bad.prepare()
    of_frames = RigRetarget(ring().shifted(z_m=0.5), source=source, geometry="lidar")
    with pytest.raises(ValueError, match="prepare: expected a geometry whose plans come back, got 'lidar'"):
        of_frames.prepare()


def test_maps_made_in_inference_mode_take_part_in_training() -> None:
    """Lightning validates in inference mode, before anything is trained."""
    source = ring()
    retarget = RigRetarget(ring().turned(yaw_deg=5), source=source, backend="torch")
    with torch.inference_mode():
        retarget({"images": smooth_images(source)})
    images = (smooth_images(source).float() / 255).requires_grad_()
    retarget({"images": images})["images"].sum().backward()
    assert images.grad is not None and images.grad.abs().sum() > 0


def test_frames_without_objects_move_too() -> None:
    """``torch.tensor([])``, as a list without boxes gives: accepted as it is, and in the target's frame."""
    source = ring()
    for frame in ("source", "target"):
        retarget = RigRetarget(ring(ground_z_m=-0.5), source=source, keys=SampleKeys(frame=frame), geometry="street")
        out = retarget({"images": smooth_images(source), "boxes_3d": torch.tensor([]), "points": torch.zeros(0, 4)})
        assert out["boxes_3d"].shape == (0,) and out["points"].shape == (0, 4)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"holes": "magic"}, "holes: expected one of continue, telea, mean, black, diffusion, got 'magic'"),
        ({"quality": "best"}, "quality: expected one of draft, fast"),
        ({"geometry": "sphere"}, "geometry: expected one of .*infinity.* got 'sphere'"),
        ({"geometry": ["infinity"]}, "geometry: expected"),
        ({"quality": ["fast"]}, "quality: expected"),
        ({"holes": 3}, "holes: expected a name or an"),
        ({"fit": "cover"}, "fit: expected one of crop, pad, stretch, got 'cover'"),
        ({"match_exposure": torch.zeros(0)}, "match_exposure"),
        ({"keys": {"frame": "source"}}, "keys: expected a SampleKeys, got dict"),
        ({"keys": "confidence"}, "keys: expected a SampleKeys"),
        ({"cache": 7}, "cache: expected a PlanCache, got int"),
        ({"cache": {"max_bytes": 3}}, "cache: expected a PlanCache"),
        ({"quality": "paper", "keys": SampleKeys(extra=("confidence",))}, "extra: quality='paper' has no 'confidence'"),
        ({"backend": "jax"}, "backend: expected one of auto, opencv, torch, got 'jax'"),
        ({"p": 1.5}, "p: expected a probability from 0 to 1, got 1.5"),
        ({"p": float("nan")}, "p: expected a probability"),
        ({"p": "x"}, "p: expected"),
        ({"p": [0.5]}, "p: expected"),
        ({"size": 256}, r"size: expected \(h, w\) in pixels, got 256"),
        *(({"size": size}, r"size: expected \(h, w\) in pixels") for size in ((0, 704), (10.5, 20), (40_000, 20))),
    ],
)
def test_impossible_settings(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RigRetarget(ring(), **settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"frame": "world"}, "frame: expected one of source, target, got 'world'"),
        ({"extra": ["depth"]}, "extra: expected one of source_camera, source_frame, confidence, sources, got 'depth'"),
        ({"extra": "confidence"}, "extra: expected names in a list or tuple"),
        ({"labels": "labels"}, "labels: expected names"),
        ({"keep": 3}, "keep: expected names"),
        ({"ignore_index": "x"}, "ignore_index: expected a number"),
    ],
)
def test_impossible_keys(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"SampleKeys.{message}"):
        SampleKeys(**settings)


# --- warnings ---------------------------------------------------------------------------------------------------------
def seen_and_behind() -> tuple[Rig, Rig]:
    """A rig of one camera, and one of the same camera and another that looks the other way."""
    source = ring().with_cameras([ring()[0]])
    return source, Rig([source[0], replace(source[0].turned(yaw_deg=180), name="behind")], name="both")


@pytest.mark.parametrize("execution", EXECUTIONS)
def test_a_camera_that_sees_nothing_of_the_sources(execution: str) -> None:
    source, target = seen_and_behind()
    retarget = RigRetarget(target, backend=execution, keys=SampleKeys(labels=["classes"], ignore_index=9))
    sample = sample_of(source, classes=torch.ones((1, *SIZE), dtype=torch.uint8))
    with pytest.warns(UserWarning, match=r"target rig 'both' cannot be reached from this data: covered are behind 0%"):
        out = retarget(sample)
    assert not out["coverage"][1].any() and (out["classes"][1] == 9).all() and out["generated"][1].all()
    assert "no source camera looks there" in str(retarget.explain(sample))
    retarget(sample)
    retarget({**sample, "cam2ego": sample["cam2ego"] + 0.0})  # once, whatever comes


@pytest.mark.parametrize(("quality", "execution"), [*(("fast", one) for one in EXECUTIONS), ("paper", "auto")])
def test_a_rig_that_sees_nothing_of_the_sources(quality: Any, execution: Any) -> None:
    source = ring().with_cameras([ring()[0]])
    retarget = RigRetarget(source.turned(yaw_deg=180), quality=quality, backend=execution)
    for _ in range(2):  # each time
        with pytest.raises(SampleError, match=r"got none\. No source camera looks where the target's do"):
            retarget(sample_of(source))


def test_an_object_that_hides_everything_is_no_error() -> None:
    source = ring().with_cameras([ring()[0]])
    before = torch.tensor([[3.0, 0, 20.0, 0.5, 40, 40, 0]])
    out = RigRetarget(source.shifted(x_m=8.0), geometry="boxes")({**sample_of(source), "boxes_3d": before})
    assert not out["coverage"].any()


def test_points_hide_no_mistake_in_the_poses() -> None:
    """Over the street, cameras of the world's frame see something at any distance."""
    world = np.eye(4)
    world[:3, 3] = 664_000, 5_400_000, 430
    sample = helpers.street_sample()
    rig = sample["rig"].with_cameras([camera.moved(world) for camera in sample["rig"]])
    with pytest.raises(SampleError, match=r"source's cam2ego seems to be poses in the world's frame: pass np\.linalg"):
        RigRetarget(sample["rig"].shifted(z_m=1))({**sample, "rig": rig})


@pytest.mark.parametrize(
    ("settings", "note"),
    [
        ({}, "filled in from its surroundings and marked in 'generated'"),
        ({"holes": "mean"}, "given the mean colour of the views and marked"),
        ({"holes": "black"}, "black: train with 'coverage' as a mask"),
        ({"holes": "telea"}, "inpainted and marked"),
    ],
)
def test_the_warning_says_what_becomes_of_pixels_that_no_source_sees(settings: dict[str, Any], note: str) -> None:
    source, target = seen_and_behind()
    with pytest.warns(UserWarning, match=f"The rest (is )?{note}"):
        RigRetarget(target, **settings)(sample_of(source))


# --- executions, gradients and memory ---------------------------------------------------------------------------------
def test_gradients_flow_to_the_images() -> None:
    source = ring()
    sample = sample_of(source, torch.float32)
    sample["images"].requires_grad_()
    retarget = RigRetarget(ring().turned(yaw_deg=10), quality=RenderConfig(interpolation="linear"))
    out = retarget(sample)
    out["images"].sum().backward()
    gradient = sample["images"].grad
    assert gradient is not None and gradient.isfinite().all() and gradient.abs().sum() > 0
    # Bilinear weights sum to 1: every covered value passes a gradient of 1 on.
    assert gradient.sum() == pytest.approx(3 * float(out["coverage"].sum()), rel=0.01)
    plain = retarget(sample_of(source, torch.float32))
    assert (out["images"].detach() - plain["images"]).abs().mean() < 1e-3
    with pytest.raises(SampleError, match="backend='opencv': expected CPU images without gradients"):
        RigRetarget(ring(), backend="opencv")(sample)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_on_a_gpu() -> None:
    source, retarget = ring(), RigRetarget(with_mask(ring().turned(yaw_deg=10)), keys=SampleKeys(labels=["classes"]))
    sample = default_collate([sample_of(source, classes=torch.ones((4, *SIZE), dtype=torch.uint8))] * 2)
    expected = RigRetarget(with_mask(ring().turned(yaw_deg=10)), keys=SampleKeys(labels=["classes"]), backend="torch")(
        sample
    )
    out = retarget({key: value.cuda() for key, value in sample.items()})
    for key in ("images", "coverage", "ego_mask", "classes", "K", "cam2ego"):
        assert out[key].device.type == "cuda", key
    assert (out["images"].cpu().int() - expected["images"].int()).abs().max() <= 1
    assert torch.equal(out["coverage"].cpu(), expected["coverage"])
    assert torch.equal(out["classes"].cpu(), expected["classes"])


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32, torch.float64])
@pytest.mark.parametrize("execution", EXECUTIONS)
def test_outputs_own_their_memory(execution: str, dtype: torch.dtype) -> None:
    source = ring()
    target = with_mask(source.turned(yaw_deg=10))
    retarget = RigRetarget(target, backend=execution, keys=SampleKeys(extra=["source_camera"]))
    samples = [sample_of(source, dtype, seed=k) for k in range(2)]
    first = retarget(samples[0])
    kept = copy.deepcopy(first)
    second = retarget(samples[1])
    assert same(first, kept) and not torch.equal(first["images"], second["images"])
    untouched = samples[0]["images"].clone()
    for value in first.values():
        if isinstance(value, torch.Tensor):
            value.zero_()
    assert torch.equal(samples[0]["images"], untouched)
    assert same(retarget(samples[0]), kept)  # neither the cached plan nor the rigs were touched


# --- what surrounds a call --------------------------------------------------------------------------------------------
def test_another_default_device_changes_nothing() -> None:
    sample = SyntheticDrive(demo_source_rig((36, 64)), num_frames=1)[0]
    expected = RigRetarget("waymo", size=(36, 64))(sample)
    outs = []
    try:
        with torch.device("meta"):
            outs.append(RigRetarget("waymo", size=(36, 64))(sample))
        torch.set_default_device("meta")
        outs.append(RigRetarget("waymo", size=(36, 64))(sample))
    finally:
        torch.set_default_device(None)
    for rendered, key in product(outs, ("images", "coverage", "K", "cam2ego", "points", "boxes_3d")):
        assert torch.equal(rendered[key], expected[key]), key


@pytest.mark.slow
def test_a_compiled_transform_runs_as_it_is() -> None:
    sample = SyntheticDrive(demo_source_rig((36, 64)), num_frames=1)[0]
    retarget = RigRetarget("waymo", size=(36, 64))
    expected, compiled = retarget(sample), torch.compile(retarget)(sample)
    assert torch.equal(compiled["images"], expected["images"]) and compiled.keys() == expected.keys()


def test_explain_changes_nothing_but_the_random_state() -> None:
    source = ring()
    retarget, sample = RigRetarget(ring().turned(yaw_deg=5)), sample_of(source)
    expected = retarget(sample)
    retarget.explain(sample)
    assert same(retarget(sample), expected) and retarget.renderer.plans.misses == 1
