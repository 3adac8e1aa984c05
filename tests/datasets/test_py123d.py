"""Logs that py123d's own writer wrote, read, rendered and converted."""

from __future__ import annotations

import os
import pickle
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug.__main__ import main
from arbiview_aug.cameras.rotations import yaw_matrix
from arbiview_aug.datasets import FrameFolder, Neighbours, Py123dDataset, open_data
from arbiview_aug.datasets import py123d as logs
from arbiview_aug.errors import CalibrationError, DataError
from tests.cli.convert.drives import command, tree

PACKAGE = pytest.importorskip("py123d.api", reason="py123d is not installed: pip install 'arbiview_aug[py123d]'")

import py123d.datatypes as d  # noqa: E402
import py123d.geometry as g  # noqa: E402
from py123d.api.scene.arrow.arrow_log_writer import ArrowLogWriter  # noqa: E402
from py123d.api.scene.arrow.utils.log_writer_config import LogWriterConfig  # noqa: E402
from py123d.parser.base_dataset_parser import ModalitiesSync  # noqa: E402
from py123d.parser.registry import KITTI360BoxDetectionLabel  # noqa: E402

START_US = 1_700_000_000_000_000
SIZE = (48, 80)
IDENTITY = g.PoseSE3.identity()
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # camera axes in the ego frame


def pose(matrix: np.ndarray) -> Any:
    return g.PoseSE3.from_transformation_matrix(matrix)


def turned(yaw: float, position_m: tuple[float, ...], axes: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = yaw_matrix(yaw) @ axes, position_m
    return matrix


def mounted(yaw_deg: float, x_m: float) -> np.ndarray:
    return turned(np.deg2rad(yaw_deg), (x_m, 0.1, 1.2), FORWARD)


def ego2world(k: int) -> np.ndarray:
    """A vehicle that turns and drives."""
    return turned(0.3 + 0.02 * k, (100 + 1.4 * k, 50 + 0.5 * k, 2), np.eye(3))


def cameras() -> list[Any]:
    def posed(kind: Any, *given: Any, yaw_deg: float, x_m: float) -> Any:
        return kind(*given, width=SIZE[1], height=SIZE[0], camera_to_imu_se3=pose(mounted(yaw_deg, x_m)))

    pinhole = d.PinholeIntrinsics(fx=42.0, fy=43.0, cx=39.0, cy=23.0)
    bent = d.PinholeDistortion(k1=-0.05, k2=0.01, p1=0.001, p2=-0.002, k3=0.0)
    mirror = 2.2, d.FisheyeMEIDistortion(0.017, 1.65, 0.0, 0.0), d.FisheyeMEIProjection(80.0, 81.0, 39.2, 23.7)
    return [
        posed(d.PinholeCameraMetadata, "front", d.CameraID.PCAM_F0, pinhole, None, yaw_deg=0, x_m=1.5),
        posed(d.PinholeCameraMetadata, "left", d.CameraID.PCAM_L0, pinhole, bent, yaw_deg=70, x_m=1.0),
        posed(d.FisheyeMEICameraMetadata, "right", d.CameraID.FMCAM_R, *mirror, yaw_deg=-80, x_m=1.0),
    ]


def write_log(root: Path, name: str = "drive", dataset: str = "kitti360", more: tuple[Any, ...] = ()) -> Path:
    """Three iterations; the left camera does not record in the second."""
    config = LogWriterConfig(camera_store_option="png_binary", lidar_store_option="binary", lidar_codec="ipc")
    writer = ArrowLogWriter(config, logs_root=root / "logs", sensors_root=root / "sensors")
    assert writer.reset(d.LogMetadata(dataset, f"{dataset}_train", name, "somewhere"))
    center = g.PoseSE3.from_R_t(np.eye(3), np.array([1.4, 0.0, 0.5]))
    ego = d.EgoStateSE3Metadata("car", 1.9, 4.6, 1.6, 2.7, center, IDENTITY)
    lidar: Any = d.LidarMetadata("top", d.LidarID.LIDAR_TOP, IDENTITY)
    if name == "merged":
        lidar = d.LidarMergedMetadata({d.LidarID.LIDAR_TOP: lidar})
    boxes = d.BoxDetectionsSE3Metadata(KITTI360BoxDetectionLabel)
    rng = np.random.default_rng(0)
    for k in range(3):
        time = d.Timestamp.from_us(START_US + 500_000 * k)
        modalities: list[Any] = [d.EgoStateSE3.from_imu(pose(ego2world(k)), ego, time)]
        for metadata in (*cameras(), *more):
            if (metadata.camera_name, k) != ("left", 1):
                image = np.full((metadata.height, metadata.width, 3), 40, np.uint8)
                image[:, : metadata.width // 2, 0] = 200  # red, on the left
                seen = ego2world(k) @ metadata.camera_to_imu_se3.transformation_matrix
                modalities.append(d.Camera(metadata, image, pose(seen), time))
        points = (rng.random((50, 3)) * [20, 8, 2]).astype(np.float32)
        modalities.append(d.Lidar(time, time, lidar, points, None))
        at = ego2world(k) @ np.array([[1, 0, 0, 9.0], [0, 1, 0, 1], [0, 0, 1, 0.4], [0, 0, 0, 1]])
        box = g.BoundingBoxSE3(pose(at), 4.0, 2.0, 1.6)
        velocity = g.Vector3D(*(ego2world(k)[:3, :3] @ [3.0, 0, 0]))
        attributes = d.BoxDetectionAttributes(KITTI360BoxDetectionLabel.CAR, "one")
        modalities.append(d.BoxDetectionsSE3([d.BoxDetectionSE3(attributes, box, velocity)], time, boxes))
        writer.write_sync(ModalitiesSync(time, modalities))
    writer.close()
    return root


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("py123d"))


def test_what_was_written_is_read(root: Path) -> None:
    data = open_data(f"py123d:{root}", neighbours=Neighbours())
    assert isinstance(data, Py123dDataset) and len(data) == 3 and isinstance(open_data(root), Py123dDataset)
    assert data.tokens[1] == f"kitti360_train-drive-{START_US + 500_000}"
    sample = data[1]
    assert sample["rig"].names == ["front", "right"] and data[0]["rig"].names == ["front", "left", "right"]
    assert [camera.lens for camera in data[0]["rig"]] == ["pinhole", "radtan", "fisheye"]
    assert sample["rig"].ground_z_m == pytest.approx(0.5 - 0.8)
    assert np.allclose(sample["ego2world"], ego2world(1)) and sample["time_s"] == 1e-6 * (START_US + 500_000)
    assert np.allclose(sample["cam2ego"][0], mounted(0, 1.5)) and np.allclose(sample["cam2ego"][1], mounted(-80, 1.0))
    assert sample["images"].shape == (2, 3, *SIZE) and sample["images"].dtype == torch.uint8
    assert sample["images"][0, :, 5, 5].tolist() == [200, 40, 40] and sample["images"][0, 0, 5, -5] == 40
    assert torch.allclose(sample["boxes_3d"], torch.tensor([[9.0, 1, 0.4, 4, 2, 1.6, 0, 3, 0]]), atol=1e-5)
    assert sample["box_names"] == ["car"] and sample["points"].shape == (50, 3)
    assert [frame["token"] for frame in sample["neighbours"]] == [data.tokens[0], data.tokens[2]]
    before = sample["neighbours"][0]
    assert before["images"].shape == (3, 3, *SIZE) and before["rig"].names == ["front", "left", "right"]
    bare = Py123dDataset(root, load_points=False, neighbours=Neighbours())[1]["neighbours"][0]
    assert before["points"].shape == (50, 3) and "points" not in set(bare)
    assert b"Py123dDataset" not in pickle.dumps(before)
    for kind in (root / "logs", root / "logs" / "kitti360_train", root / "logs" / "kitti360_train" / "drive"):
        assert len(Py123dDataset(kind)) == 3
    halved = Py123dDataset(root, reduce=2)[0]
    assert halved["images"].shape == (3, 3, 24, 40) and halved["rig"][0].size == (24, 40)


def test_cameras_project_as_those_of_py123d(root: Path) -> None:
    sample = Py123dDataset(root)[0]
    rng = np.random.default_rng(1)
    for camera, theirs, within_px in zip(sample["rig"], cameras(), (1e-6, 1e-6, 0.5), strict=True):
        angle, around = np.deg2rad(rng.uniform(0, 88 if camera.lens == "fisheye" else 40, 400)), rng.uniform(0, 7, 400)
        p = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], -1) * 7
        expected, inside, _ = theirs.project_to_image(p)
        in_ego = p @ camera.cam2ego[:3, :3].T + camera.cam2ego[:3, 3]
        uv, valid = camera.project(in_ego)[:2]
        assert inside.sum() > 50 and valid[inside].all()
        assert np.abs(uv - expected)[inside].max() < within_px


def test_f_theta_is_the_forward_polynomial(tmp_path: Path) -> None:
    """Numbers like those of a front wide camera of PhysicalAI-AV, written and read."""
    forward, backward = np.array([0, 935.3, -9.6, 41, -32.5, 2]), np.array([0, 1.0692e-3, 1.2e-8, -4e-11, 3e-14, 0])
    intrinsics = d.FThetaIntrinsics(956.2, 543.7, forward, backward)
    wide = d.FThetaCameraMetadata("wide", d.CameraID.FTCAM_F0, intrinsics, 1920, 1080, pose(mounted(0, 1.6)))
    write_log(tmp_path, more=(wide,))
    camera = Py123dDataset(tmp_path)[0]["rig"]["wide"]
    assert camera.lens == "ftheta" and camera.K[0, 0] == 935.3 and 110 < camera.fov_deg[0] < 125
    angle, around = np.random.default_rng(2).uniform(0, [[1.0], [7.0]], (2, 400))
    p = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], -1)
    np.testing.assert_allclose(camera.project_cam(p).uv, wide.project_to_image(p)[0], atol=1e-9)
    constant = SimpleNamespace(fw_poly=[3.0, 900.0, 0, 0, 0], cx=0.0, cy=0.0)
    with pytest.raises(CalibrationError, match="camera 'wide': expected a forward polynomial without a constant term"):
        logs._ftheta(constant, "camera 'wide'")


def test_other_lenses_and_broken_logs_are_named(root: Path, tmp_path: Path) -> None:
    for folder, names, message in (
        (tmp_path, None, r"expected logs .folders with sync.arrow., found none"),
        (root, ["front", "lefft"], "cameras: expected names of its cameras, got lefft"),
        (root, "a front one", r"expected cameras \['a front one'\], found none of them"),
    ):
        with pytest.raises(DataError, match=message):
            Py123dDataset(folder, cameras=names)
    for one in ("front", ["front"]):
        assert Py123dDataset(root, cameras=one)[0]["rig"].names == ["front"]
    metadata = SimpleNamespace(camera_name="wide", camera_model=d.CameraModel.FTHETA, intrinsics=None)
    with pytest.raises(CalibrationError, match=r"camera 'wide': expected a calibrated pinhole, .*, got ftheta"):
        logs._camera(metadata, "log")
    write_log(tmp_path)
    folder = tmp_path / "logs" / "kitti360_train" / "drive"
    for name in ("sync.arrow", "ego_state_se3.arrow"):
        sound = (folder / name).read_bytes()
        for content in (b"", sound[:300], b"x" * 300):
            (folder / name).write_bytes(content)
            with pytest.raises(DataError, match="py123d log"):
                _ = Py123dDataset(tmp_path)[0]
        (folder / name).write_bytes(sound)


def test_an_iteration_without_a_pose_is_no_neighbour(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ego2world = logs._Log.ego2world
    monkeypatch.setattr(logs._Log, "ego2world", lambda log, k: None if k == 1 else ego2world(log, k))
    dataset = Py123dDataset(root, neighbours=Neighbours())
    assert [frame["token"] for frame in dataset[0]["neighbours"]] == [dataset.tokens[2]]
    assert [frame["rig"].names for frame in dataset[2]["neighbours"]] == [dataset[0]["rig"].names]
    with pytest.raises(DataError, match="iteration 1: expected the ego's pose, got none"):
        dataset[1]


def test_logs_are_converted(root: Path, tmp_path: Path) -> None:
    convert = command(f"py123d:{root}", tmp_path / "new", "--images", "png", "--neighbours", "1", "--points", "source")
    assert main(convert) == 0
    old, new = open_data(root, neighbours=Neighbours()), FrameFolder(tmp_path / "new", neighbours=Neighbours())
    assert new.tokens == old.tokens
    for before, after in ((old[k], new[k]) for k in range(3)):
        assert after["images"].shape == (3, 3, 24, 40)
        assert all(np.array_equal(before[key], after[key]) for key in ("points", "boxes_3d", "ego2world", "time_s"))
        assert [one["token"] for one in before["neighbours"]] == [one["token"] for one in after["neighbours"]]
    files = tree(tmp_path / "new")
    assert main(convert) == 0 and tree(tmp_path / "new") == files


def test_several_logs(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_log(tmp_path / "source", dataset="physical-ai-av")
    write_log(tmp_path / "source", "merged", dataset="physical-ai-av")
    assert main(command(f"py123d:{tmp_path / 'source'}", tmp_path / "new")) == 0
    said = capsys.readouterr().err
    assert "no sequence.json" in said and not (tmp_path / "new" / "sequence.json").exists()
    data = open_data(tmp_path / "source", neighbours=Neighbours(count=9))
    assert "-merged-" in data.tokens[3] and torch.equal(data[3]["points"], data[0]["points"])
    assert all("-drive-" in frame["token"] for frame in data[2]["neighbours"])


def test_damaged_tables_are_refused(tmp_path: Path) -> None:
    """Offsets beyond the file's end let pyarrow crash."""
    path = next(write_log(tmp_path).rglob("box_detections_se3.arrow"))
    data = path.read_bytes()
    for at in range(8, len(data), 40):
        path.write_bytes(data[:at] + b"\xff\xff\xff\x7f" + data[at + 4 :])
        with suppress(DataError):
            Py123dDataset(tmp_path)[0]
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(DataError, match=r"expected a regular file box_detections_se3\.arrow"):
        Py123dDataset(tmp_path)
