"""Detectors read the calibration, in the package's conventions, and nothing that no camera saw; scans by pillars."""

import json

import numpy as np
import pytest
import torch

from integrations.cross_rig.families import DEPTHS_M, FAMILIES, STRIDE, Batch, Depths, read_at
from integrations.cross_rig.frames import source_rig
from integrations.cross_rig.labels import VEHICLE, Grid
from integrations.cross_rig.model import Detector, PillarDetector, PointSet
from integrations.cross_rig.scans import CHANGES, kinds, main, point_set, scans_of

SIZE = (32, 64)
GRID = Grid(side_m=20.0, cells=20)


def batch(rigs, images=None, coverage=None) -> Batch:
    count = sum(len(rig) for rig in rigs)
    if images is None:
        images = torch.randint(0, 255, (count, 3, *SIZE), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    return Batch(
        images=images,
        coverage=torch.ones((count, *SIZE), dtype=torch.bool) if coverage is None else coverage,
        K=torch.from_numpy(np.concatenate([rig.K for rig in rigs])).float(),
        cam2ego=torch.from_numpy(np.concatenate([rig.cam2ego for rig in rigs])).float(),
        frame=torch.arange(len(rigs)).repeat_interleave(torch.tensor([len(rig) for rig in rigs])),
        state=torch.zeros((len(rigs), 20, 20), dtype=torch.uint8),
        counts=torch.ones((len(rigs), 20, 20), dtype=torch.bool),
        boxes=torch.full((len(rigs), 3, 7), torch.nan),
    )


@pytest.fixture(params=FAMILIES)
def model(request) -> Detector:
    torch.manual_seed(0)
    return Detector(GRID, request.param).eval()


def test_points_read_the_pixel_that_they_project_to():
    """A feature map that holds its own pixel coordinates gives the camera model's projection."""
    front = source_rig(SIZE)["front"]
    frames = batch([source_rig(SIZE).with_cameras([front])])
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(4, 20, 200), rng.uniform(-8, 8, 200), rng.uniform(0, 3, 200)], 1)
    v, u = np.indices((SIZE[0] // STRIDE, SIZE[1] // STRIDE)) * STRIDE + (STRIDE - 1) / 2
    maps = torch.from_numpy(np.stack([u, v])[None]).float()
    read = read_at(maps, frames, torch.from_numpy(points).float()[None])[0].numpy()
    uv, depth, _ = front.project(points)
    inner = (depth > 0) & (uv > STRIDE / 2).all(-1) & (uv < np.array(SIZE[::-1]) - 1 - STRIDE / 2).all(-1)
    assert inner.sum() > 50
    np.testing.assert_allclose(read[inner], uv[inner], atol=2e-3)
    outside = (depth <= 0) | (uv < -0.5).any(-1) | (uv > (SIZE[1] - 0.5, SIZE[0] - 0.5)).any(-1)
    assert outside.any() and not read[outside].any()


def test_features_are_lifted_to_where_their_rays_lead():
    """All of the probability at one depth: the cell that the camera model gives."""
    family, front = Depths(GRID, 4, 8), source_rig(SIZE)["front"]
    frames = batch([source_rig(SIZE).with_cameras([front])])
    for depth in (3, 6):
        probability = torch.zeros(1, len(DEPTHS_M), SIZE[0] // 4, SIZE[1] // 4)
        probability[0, DEPTHS_M.index(depth), 4, 10] = 1
        lifted = family.lifted(torch.ones(1, 1, SIZE[0] // 4, SIZE[1] // 4), frames, probability)[:, 0]
        (cell,) = lifted.nonzero()
        rays, _ = front.unproject_cam(np.array([[10 * 4 + 1.5, 4 * 4 + 1.5]]))
        point = front.cam2ego[:3, :3] @ (rays[0] / rays[0, 2] * depth) + front.center_m
        assert (int(cell) // 10, int(cell) % 10) == tuple(int(c) for c in (point[:2] + 10) // 2)
        assert lifted[cell] == 1


def test_uncovered_pixels_do_not_matter(model):
    rig = source_rig(SIZE)
    coverage = torch.ones((6, *SIZE), dtype=torch.bool)
    coverage[:, :16, :40] = False
    whole = batch([rig], coverage=coverage)
    painted = whole.images.clone()
    painted[~coverage[:, None].expand_as(painted)] = 7
    with torch.no_grad():
        torch.testing.assert_close(model(whole), model(batch([rig], images=painted, coverage=coverage)))
    nothing = batch([rig], coverage=torch.zeros_like(coverage))
    assert not read_at(torch.ones(6, 4, SIZE[0] // STRIDE, SIZE[1] // STRIDE), nothing, torch.rand(50, 3) * 20).any()


def test_calibration_is_read_and_frames_do_not_mix(model):
    """The same images from cameras elsewhere say something else; frames may differ in their number of cameras."""
    rig = source_rig(SIZE)
    both = batch([rig, rig.with_cameras(rig.cameras[:3])])
    parts = [(rig, both.images[:6]), (rig.with_cameras(rig.cameras[:3]), both.images[6:])]
    with torch.no_grad():
        raised = model(batch([rig.shifted(0, 0, 0.7)], images=both.images[:6]))
        together, alone = model(both), [model(batch([r], images=images)) for r, images in parts]
    assert not torch.allclose(alone[0].occupancy, raised.occupancy, atol=1e-4)
    for whole, *each in zip(together, *alone, strict=True):
        torch.testing.assert_close(whole, torch.cat(each), atol=1e-4, rtol=1e-4)


# --- scans ------------------------------------------------------------------------------------------------------------
def scan(*points) -> dict:
    boxes, state = np.full((3, 7), np.nan, np.float32), np.zeros((100, 100), np.uint8)
    return {"points": np.array(points, np.float16), "state": state, "boxes": boxes}


def test_a_point_is_in_the_pillar_over_its_cell():
    """Row by x, column by y, as ``Grid.centres`` says; all other pillars are empty."""
    x, y = Grid().centres()[70, 20]
    with torch.no_grad():
        scans = PointSet.joined([scan([x, y, 1.0, 90.0]), scan([0.0, 0.0, 0.0, 0.0])])
        pillars = PillarDetector(Grid()).eval().pillars(scans)
    assert pillars.shape == (2, 32, 100, 100)
    assert pillars[0].any(0).nonzero().tolist() == [[70, 20]] and pillars[1].any(0).nonzero().tolist() == [[50, 50]]


def test_sets_that_are_the_same_have_one_name():
    assert scans_of("fewer", "oracle") == scans_of("more", "raw") == scans_of("up70", "dropped")
    assert scans_of("fewer", "dropped") == (*CHANGES["fewer"], "dropped")
    assert scans_of("sixteen", "below") == scans_of("sixteen", "retargeted")
    assert [change for change in CHANGES if "below" in kinds(change)] == ["sixteen"]


def test_vehicles_count_by_their_points():
    """Labels are of the points that a detector gets: fewer vehicles where fewer were measured."""
    a, b = CHANGES["fewer"]
    recorded, dropped, retargeted = (point_set(a, b, kind, "val", 2) for kind in ("raw", "dropped", "retargeted"))
    assert len(dropped.points[0]) < len(recorded.points[0])
    seen = [(scans.state == VEHICLE).sum() for scans in (recorded, retargeted)]
    assert 0 < seen[1] <= seen[0] and recorded.counts.all()


@pytest.mark.slow
def test_a_study_continues_where_it_was(tmp_path, capsys, monkeypatch):
    asked = ["--changes", "sixteen", "--seeds", "0", "--train-frames", "2", "--val-frames", "1", "--test-frames", "2"]
    asked += ["--steps", "2", "--output", str(tmp_path)]
    assert main(asked) == 0
    first = capsys.readouterr()
    assert first.out.count("| 32 beams at 1.8 m -> 16 beams at 1.8 m |") == 5 and first.err.count("CPU s") == 5
    assert "A's points, rings dropped" in first.out and "without B's rings above A's" in first.out
    results = sorted(tmp_path.iterdir())
    assert len(results) == 5 and json.loads(results[0].read_text())["positives"]
    results[1].unlink()
    assert main(asked) == 0
    again = capsys.readouterr()
    assert again.out == first.out and again.err.count("CPU s") == 1
