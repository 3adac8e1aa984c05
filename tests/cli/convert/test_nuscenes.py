"""nuScenes roots converted: tables that hold together, and what our reader finds in them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from arbiview_aug import Camera, Rig, RigRetarget
from arbiview_aug.__main__ import main
from arbiview_aug.cli.convert.nuscenes import level, token_of, visible_shares
from arbiview_aug.datasets import NuScenesDataset
from tests.cli.convert.drives import SURROUND, TARGET, chained, command, read_tables, write_nuscenes

LEFT_OUT = "goes-sample-1"


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_nuscenes(tmp_path_factory.mktemp("nuscenes"))


@pytest.fixture(scope="module")
def output(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("converted") / "new"
    assert main(command(source, folder, "--images", "png")) == 0
    return folder


def test_the_reader_finds_what_was_rendered(source: Path, output: Path) -> None:
    old, new = NuScenesDataset(source), NuScenesDataset(output)
    assert new.tokens == old.tokens and new.channels == sorted(TARGET.names)
    retarget = RigRetarget(TARGET, size=(24, 40), geometry="street")
    order = [TARGET.names.index(channel) for channel in new.channels]
    for index in (0, 4):
        before, after = old[index], new[index]
        out = retarget(before)
        assert torch.equal(after["images"], out["images"][order])
        for key in ("coverage", "generated"):
            assert torch.equal(after[key], out[key][order]) and after[key].any()
        masks = [path for path in new.files(index) if path.suffixes[:1] == [".coverage"]]
        assert len(masks) == len(order) and new.files(index)[-1].suffix == ".bin"
        # In the ego frame at the LiDAR's time, while the vehicle of the first scene moves at 8 m/s.
        assert torch.allclose(after["cam2ego"], out["cam2ego"][order], atol=1e-9)
        assert torch.allclose(after["K"], out["K"][order])
        assert after["time_s"] == before["time_s"] and after["box_tokens"] == before["box_tokens"]
        for key in ("boxes_3d", "ego2world"):
            assert torch.equal(after[key], before[key])
        assert len(after["points"]) > 20
        assert torch.allclose(after["points"][:, :4], out["points"][:, :4], atol=1e-4)
        assert torch.equal(after["points"][:, 4].int(), out["point_rings"])


def test_the_tables_hold_together(source: Path, output: Path) -> None:
    old, new = read_tables(source), read_tables(output)
    assert set(new) == set(old) - {"image_annotations"}
    for table in ("category", "instance", "map", "sample", "scene", "visibility"):
        assert new[table] == old[table]
    tokens = {table: {row["token"] for row in rows} for table, rows in new.items()}
    for row in new["sample_data"]:
        assert row["sample_token"] in tokens["sample"] and row["ego_pose_token"] in tokens["ego_pose"]
        assert row["calibrated_sensor_token"] in tokens["calibrated_sensor"] and (output / row["filename"]).is_file()
    assert {row["sensor_token"] for row in new["calibrated_sensor"]} == tokens["sensor"]
    assert len(tokens["sample_data"]) == len(new["sample_data"]) and chained(new["sample_data"])
    used = {row["ego_pose_token"] for row in new["sample_data"]}
    assert tokens["ego_pose"] == used


def test_new_cameras_record_when_the_lidar_did(output: Path) -> None:
    tables = read_tables(output)
    sensor_of = {row["token"]: row["sensor_token"] for row in tables["calibrated_sensor"]}
    channels = {row["token"]: row["channel"] for row in tables["sensor"]}
    by_sample: dict[str, dict[str, dict]] = {}
    for row in tables["sample_data"]:
        if row["is_key_frame"]:
            channel = channels[sensor_of[row["calibrated_sensor_token"]]]
            by_sample.setdefault(row["sample_token"], {})[channel] = row
    assert len(by_sample) == 6
    for rows in by_sample.values():
        lidar, camera = rows["LIDAR_TOP"], rows["ring_front_center"]
        assert camera["timestamp"] == lidar["timestamp"] and camera["ego_pose_token"] == lidar["ego_pose_token"]
        assert (camera["height"], camera["width"], camera["fileformat"]) == (24, 40, "png")
        assert camera["token"] == token_of(camera["sample_token"], "ring_front_center")
        for mask in ("coverage", "confidence"):
            assert (output / camera["filename"]).with_suffix(f".{mask}.png").is_file()
    first = by_sample["goes-sample-0"]["ring_front_center"]
    assert first["prev"] == "" and first["next"] == token_of("goes-sample-1", "ring_front_center")


def test_scans_are_the_targets(source: Path, output: Path) -> None:
    """One file for both scanners at each keyframe, in the first one's frame; no sweeps of the source's."""
    tables, first = read_tables(output), TARGET.in_frame_of(SURROUND).lidars[0]
    (sensor,) = (row["token"] for row in tables["sensor"] if row["channel"] == "LIDAR_TOP")
    (calibrated,) = (row for row in tables["calibrated_sensor"] if row["sensor_token"] == sensor)
    assert np.allclose(calibrated["translation"], first.center_m) and calibrated["camera_intrinsic"] == []
    rows = [row for row in tables["sample_data"] if row["calibrated_sensor_token"] == calibrated["token"]]
    assert len(rows) == 6 and all(row["is_key_frame"] for row in rows) and not (output / "sweeps/LIDAR_TOP").exists()
    retarget, data = RigRetarget(TARGET, geometry="street"), NuScenesDataset(source)
    counts = {row["token"]: row["num_lidar_pts"] for row in tables["sample_annotation"]}
    for sample in (data[0], data[4]):
        expected = retarget(sample)["num_points"].tolist()
        assert [counts[token] for token in sample["box_tokens"]] == expected
    assert sum(counts.values()) > 0


def test_tables_that_label_points(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = shutil.copytree(source, tmp_path / "source")
    tables = read_tables(root)
    (root / "labels").mkdir()
    (root / "labels" / "one.bin").write_bytes(b"1")
    row = {"token": "one", "filename": "labels/one.bin", "sample_data_token": tables["sample_data"][0]["token"]}
    (root / "v1.0-mini" / "lidarseg.json").write_text(json.dumps([row]))
    assert main(command(root, tmp_path / "new")) == 0
    assert "label the points that were measured: tables lidarseg" in capsys.readouterr().err
    assert "lidarseg" not in read_tables(tmp_path / "new") and not (tmp_path / "new" / "labels").exists()


def test_other_sensors_are_linked(source: Path, output: Path, tmp_path: Path) -> None:
    rows = [row for row in read_tables(source)["sample_data"] if row["filename"].endswith(".bin")]
    radar = [row for row in rows if "RADAR" in row["filename"]]
    assert 6 < len(radar) < len(rows)  # LiDAR and radar, sweeps too
    assert all((output / row["filename"]).samefile(source / row["filename"]) for row in radar)
    assert (output / "maps" / "map.png").samefile(source / "maps" / "map.png")
    assert main(command(source, tmp_path / "new", "--points", "source")) == 0
    assert all((tmp_path / "new" / row["filename"]).samefile(source / row["filename"]) for row in rows)


def test_scans_without_a_return(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No file of no bytes, which readers take for a truncated one."""
    rig = TARGET
    replace(rig, lidars=[replace(rig.lidars[0], range_m=(0.1, 0.2))]).save(tmp_path / "blind.json")
    assert main(command(source, tmp_path / "new", "--target", str(tmp_path / "blind.json"))) == 1
    assert "expected returns of the target's scanners, got none; --points source" in capsys.readouterr().err


def test_tables_of_any_name(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One that changed since is found."""
    root = shutil.copytree(source, tmp_path / "source")
    (root / "v1.0-mini").rename(root / "simulated")
    asked = command(f"nuscenes:{root}", tmp_path / "new", "--version", "simulated")
    assert main(asked) == 0
    table = root / "simulated" / "calibrated_sensor.json"
    table.write_text(table.read_text() + " ")
    capsys.readouterr()
    assert main(asked) == 2
    assert "got another source.tables.calibrated_sensor; name another folder" in capsys.readouterr().err


def test_visibility_is_at_most_what_people_saw(source: Path, output: Path) -> None:
    old, new = (read_tables(root)["sample_annotation"] for root in (source, output))
    levels = [(a["visibility_token"], b["visibility_token"]) for a, b in zip(old, new, strict=True)]
    assert all("1" <= b <= a for a, b in levels) and any(b < a for a, b in levels) and any(b == "4" for _, b in levels)
    stripped = [{k: v for k, v in row.items() if k != "visibility_token"} for row in old]
    changed = ("visibility_token", "num_lidar_pts")
    assert stripped == [{k: v for k, v in row.items() if k not in changed} for row in new]


def test_lidar_files_of_one_name(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Samples would write over each other's images."""
    files = [path.relative_to(source) for path in (files[-1] for files in map(NuScenesDataset(source).files, (1, 4)))]
    moved = [path.parent / f"scene-{k}" / "000012.bin" for k, path in enumerate(files)]
    root = shutil.copytree(source, tmp_path / "source")
    table = root / "v1.0-mini" / "sample_data.json"
    for path, new in zip(files, moved, strict=True):
        (root / new).parent.mkdir()
        (root / path).rename(root / new)
        table.write_text(table.read_text().replace(str(path), str(new)))
    assert main(command(root, tmp_path / "new")) == 2
    assert "got 2 of the name 000012.bin" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_sample_that_is_left_out_leaves_no_trace(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its LiDAR frame, where they are kept, is a sweep of the next; chains and counts go on without it."""
    shutil.copytree(source, tmp_path / "source")
    (tmp_path / "source" / NuScenesDataset(source).files(1)[2].relative_to(source)).write_bytes(b"\xff\xd8 cut off")
    assert main(command(tmp_path / "source", tmp_path / "new")) == 1
    assert not (tmp_path / "new" / "v1.0-mini").exists()
    assert main(command(tmp_path / "source", tmp_path / "new", "--on-error", "skip")) == 0
    said = capsys.readouterr().err
    assert said.count(f"{LEFT_OUT}: failed: camera ") == 1 and said.count(f"{LEFT_OUT}: skipped: camera ") == 1
    old, new = read_tables(source), read_tables(tmp_path / "new")
    assert {row["token"] for row in old["sample"]} - {row["token"] for row in new["sample"]} == {LEFT_OUT}
    assert not any(LEFT_OUT in json.dumps(rows) for rows in new.values())
    for table in ("sample", "sample_annotation", "sample_data"):
        assert chained(new[table])
    (scene,) = [row for row in new["scene"] if row["token"] == "goes"]
    assert scene["nbr_samples"] == 2 and scene["last_sample_token"] == "goes-sample-2"
    annotations = {row["token"]: row for row in new["sample_annotation"]}
    for row in new["instance"]:
        of = [a for a in annotations.values() if a["instance_token"] == row["token"]]
        assert len(of) == row["nbr_annotations"] and row["first_annotation_token"] in annotations
    assert not any(row["token"] == "goes-LIDAR_TOP-1-0" for row in new["sample_data"])
    kept = command(tmp_path / "source", tmp_path / "kept", "--on-error", "skip", "--points", "source")
    assert main(kept) == 0
    rows = read_tables(tmp_path / "kept")
    assert chained(rows["sample_data"])
    (sweep,) = [row for row in rows["sample_data"] if row["token"] == "goes-LIDAR_TOP-1-0"]
    assert sweep["sample_token"] == "goes-sample-2" and not sweep["is_key_frame"]
    one, two = ({row["token"] for row in rows["sample_data"] if "LIDAR_TOP" in row["token"]} for rows in (old, rows))
    assert one == two
    assert NuScenesDataset(tmp_path / "new")[1]["token"] == "goes-sample-2"
    provenance = json.loads((tmp_path / "new" / "conversion" / "provenance.json").read_text())
    assert list(provenance["skipped"]) == [LEFT_OUT]


def test_a_sample_is_left_out_where_there_are_no_labels(source: Path, tmp_path: Path) -> None:
    shutil.copytree(source, tmp_path / "source")
    for table in ("instance", "sample_annotation"):
        (tmp_path / "source" / "v1.0-mini" / f"{table}.json").unlink()
    (tmp_path / "source" / NuScenesDataset(source).files(1)[2].relative_to(source)).write_bytes(b"\xff\xd8 cut off")
    assert main(command(tmp_path / "source", tmp_path / "new", "--on-error", "skip")) == 0
    assert LEFT_OUT not in NuScenesDataset(tmp_path / "new").tokens


def test_lidar_files_that_are_missing(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A keyframe's is an error of its sample; sweeps that were not copied are a note."""
    shutil.copytree(source, tmp_path / "source")
    shutil.rmtree(tmp_path / "source" / "sweeps" / "RADAR_FRONT")
    lidar = tmp_path / "source" / NuScenesDataset(source).files(2)[-1].relative_to(source)
    content = lidar.read_bytes()
    lidar.unlink()
    assert main(command(tmp_path / "source", tmp_path / "new")) == 1
    assert "goes-sample-2: failed: points " in capsys.readouterr().err
    lidar.write_bytes(content)
    assert main(command(tmp_path / "source", tmp_path / "new")) == 0
    assert "20 files that sample_data names are not in the source" in capsys.readouterr().err


def test_lenses_are_refused_by_name(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command(source, tmp_path / "new", "--target", "fisheye_surround")) == 2
    said = capsys.readouterr().err
    assert "Front (fisheye)" in said and "Rig.undistorted()" in said
    assert not (tmp_path / "new").exists()


def test_names_of_other_sensors_are_refused(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = TARGET.to_dict()
    rig["cameras"][0]["name"] = "LIDAR_TOP"
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    assert main(command(source, tmp_path / "new", "--target", str(tmp_path / "rig.json"))) == 2
    assert "got LIDAR_TOP; rename" in capsys.readouterr().err


# --- how much of a box the new cameras show ---------------------------------------------------------------------------
K = np.array([[200.0, 0, 199.5], [0, 200.0, 199.5], [0, 0, 1]])


def looking(azimuth_deg: float) -> Camera:
    size = {"width_px": 400, "height_px": 400}
    return Camera.looking(name=f"{azimuth_deg}", azimuth_deg=azimuth_deg, position_m=(0, 0, 0), K=K, **size)


AHEAD = looking(0)
ALL = np.ones((400, 400), bool)
BOX = [20.0, 0, 0, 2, 4, 4, 0]


def shares(cameras: list[Camera], boxes: list[list[float]], coverage: list[np.ndarray] | None = None) -> list[float]:
    return visible_shares(Rig(cameras), coverage or [ALL] * len(cameras), np.array(boxes)).tolist()


def test_whole_half_hidden_and_elsewhere() -> None:
    behind = [40.0, 0, 0, 2, 4, 4, 0]
    beside = [20.0, 0, 30, 2, 4, 4, 0]
    assert shares([AHEAD], [BOX, behind, beside]) == [1, 0, 0]
    half_hidden = [40.0, 4, 0, 2, 8, 4, 0]  # y from 0 to 8; the first covers what projects within y = +-4.2 there
    assert shares([AHEAD], [BOX, half_hidden])[1] == pytest.approx(0.5, abs=0.05)


def test_only_what_some_source_saw_counts() -> None:
    left = ALL.copy()
    left[:, 200:] = False
    assert shares([AHEAD], [BOX], [left]) == pytest.approx([0.5], abs=0.05)
    assert shares([AHEAD], [BOX], [~ALL]) == [0]


def test_cut_by_the_image_and_continued_in_the_next() -> None:
    at_the_edge = [14.0, 14, 0, 2, 2, 2, np.pi / 4]  # 45 degrees: half in either camera of 90 degrees
    (one,), (two,) = shares([AHEAD], [at_the_edge]), shares([AHEAD, looking(90)], [at_the_edge])
    assert level(one, "4") == "2" and level(two, "4") == "4" and two == pytest.approx(2 * one)


def test_levels() -> None:
    """nuScenes' bins; what people saw less of is not seen more of; unknown stays unknown."""
    assert [level(share, "4") for share in (0.0, 0.39, 0.4, 0.7, 0.9)] == ["1", "1", "2", "3", "4"]
    assert (level(0.9, "2"), level(0.9, "")) == ("2", "")
