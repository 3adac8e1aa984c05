"""Frame folders converted: what our reader finds in them is what was rendered."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug import Rig, RigRetarget, SampleKeys, load_rig
from arbiview_aug.__main__ import main
from arbiview_aug.cli.convert.job import Jobs, Manifest
from arbiview_aug.cli.convert.writer import Settings
from arbiview_aug.cli.parsers import parser_of
from arbiview_aug.datasets import FrameFolder, Neighbours, WithDepth
from arbiview_aug.datasets.depth_folder import DepthFolder
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.frames import make_frame
from arbiview_aug.temporal.learned_depth import LearnedDepth
from arbiview_aug.temporal.motion_depth import MotionDepth
from tests.cli.convert.drives import TARGET, command, tree, write_frames


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_frames(tmp_path_factory.mktemp("frames") / "drive", 3)


@pytest.fixture(scope="module")
def output(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("converted") / "new"
    assert main(command(source, folder, "--images", "png", "--report", "1", "--target", "waymo")) == 0  # with lenses
    return folder


def test_the_reader_finds_what_was_rendered(source: Path, output: Path) -> None:
    old, new = FrameFolder(source), FrameFolder(output)
    assert new.tokens == old.tokens == ["0000", "0001", "0002"]
    retarget = RigRetarget(load_rig("waymo"), size=(24, 40), geometry="street", keys=SampleKeys(extra=("confidence",)))
    for before, after in zip((old[k] for k in range(3)), (new[k] for k in range(3)), strict=True):
        out = retarget(before)
        assert torch.equal(after["images"], out["images"])
        assert torch.allclose(after["cam2ego"], out["cam2ego"]) and torch.allclose(after["K"], out["K"])
        assert after["rig"].ground_z_m == before["rig"].ground_z_m == -0.1
        assert after["rig"].names == load_rig("waymo").names and after["rig"][0].lens == "radtan"
        assert after["rig"] == load_rig("waymo").resized((24, 40), "crop").in_frame_of(before["rig"])
        assert after["rig"].lidars and torch.equal(after["points"], out["points"])
        for key in ("boxes_3d", "ego2world"):
            assert torch.equal(after[key], before[key])
        assert after["time_s"] == before["time_s"]
        for key in ("coverage", "generated"):
            assert torch.equal(after[key], out[key]) and after[key].dtype == torch.bool
        calib = json.loads((output / after["token"] / "calib.json").read_text())
        assert calib["license"] == "as you like"
        for k, camera in enumerate(calib["cameras"]):
            assert camera["file"] == f"{camera['name']}.png"
            image = output / after["token"] / camera["file"]
            seen = cv2.imread(str(image.with_suffix(".coverage.png")), cv2.IMREAD_GRAYSCALE) > 0
            assert np.array_equal(seen, out["coverage"][k].numpy())
            assert (image.parent / camera["confidence"]).is_file()
            made_up = cv2.imread(str(image.parent / camera["generated"]), cv2.IMREAD_GRAYSCALE) > 0
            assert np.array_equal(made_up, out["generated"][k].numpy())


def test_coverage_is_read_back(output: Path, tmp_path: Path) -> None:
    """A reduced pixel is covered if all of its pixels are; made-up pixels are not read, in neighbours neither."""
    whole = FrameFolder(output)[1]
    half = FrameFolder(output, reduce=2, neighbours=Neighbours())[1]
    blocks = {key: whole[key].unfold(1, 2, 2).unfold(2, 2, 2).flatten(3) for key in ("coverage", "generated")}
    assert torch.equal(half["coverage"], blocks["coverage"].all(-1)) and not whole["coverage"].all()
    assert torch.equal(half["generated"], blocks["generated"].any(-1)) and half["coverage"].any()
    assert torch.equal(half["neighbours"][0]["coverage"], FrameFolder(output, reduce=2)[0]["coverage"])
    again = RigRetarget(whole["rig"], geometry="infinity")(whole)
    assert not (again["coverage"] & ~whole["coverage"]).any()
    samples = (whole, {**whole, "coverage": torch.zeros_like(whole["coverage"])})
    some, none = (len(make_frame(s, exposures=("raw",)).lidar["raw"].points.points) for s in samples)
    assert some and not none  # whose colours were made up
    shutil.copytree(output, tmp_path / "new")
    one, two = (tmp_path / "new/0000" / f"{whole['rig'].names[0]}.{key}.png" for key in ("coverage", "generated"))
    assert {one, two} < {*FrameFolder(tmp_path / "new").files(0)}
    two.unlink()
    assert not FrameFolder(tmp_path / "new")[0]["generated"][0].any()
    one.write_bytes(b"cut")
    with pytest.raises(DataError, match=r"coverage .*coverage\.png: expected an image, got a file that cannot"):
        FrameFolder(tmp_path / "new")[0]


def test_stale_entries_are_left_out(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder in sorted(shutil.copytree(source, tmp_path / "drive").glob("0*")):
        calib = json.loads((folder / "calib.json").read_text())
        calib["cameras"][0]["exposure_us"] = 3
        calib |= {"boxes_2d": [1], "lidar2img": [1], "lidar2ego": [1], "num_lidar_pts": [-5], "segmentation": "seg.png"}
        calib["lidar"] = {"file": "lidar.npy", "labels": "labels.npy"}
        (folder / "seg.png").touch()
        (folder / "calib.json").write_text(json.dumps(calib))
    gone = "boxes_2d, cameras.exposure_us, lidar.labels, lidar2img, segmentation"
    for points in ("source", "target"):
        assert main(command(tmp_path / "drive", tmp_path / points, "--points", points)) == 0
        said = gone if points == "source" else gone.replace("lidar2img", "lidar2ego, lidar2img")
        assert capsys.readouterr().err.count(f"calib.json: left out {said}: they speak of the source's") == 1
        calib = json.loads((tmp_path / points / "0000" / "calib.json").read_text())
        assert not {"boxes_2d", "lidar2img", "segmentation"} & calib.keys() and calib["license"] == "as you like"
        assert ("lidar2ego" in calib) == (points == "source") == (calib["num_lidar_pts"] == [-5])


def test_unfinished_conversions_are_told(source: Path, tmp_path: Path) -> None:
    shutil.copytree(source, tmp_path / "drive")
    image, new = tmp_path / "drive/0001/00.jpg", tmp_path / "new"
    good = image.read_bytes()
    image.write_bytes(b"")
    told = r"unfinished conversion: 2 frames so far; run convert again"
    assert main(command(tmp_path / "drive", new)) == 1
    with pytest.warns(UserWarning, match=told):
        FrameFolder(new)
    image.write_bytes(good)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert main(command(tmp_path / "drive", new)) == 0
        assert len(FrameFolder(new)) == 3
    image.write_bytes(b"")
    settings = Settings(parser_of("convert").parse_args(command(tmp_path / "drive", new)[1:]))
    assert Jobs(settings, settings.open(), [1], skip=True)[0].state == "skipped"  # and killed, before the tables
    (new / "sequence.json").unlink()
    with pytest.warns(UserWarning, match=told):
        FrameFolder(new)


def test_provenance_names_versions_settings_and_sources(source: Path, output: Path) -> None:
    said = json.loads((output / "conversion" / "provenance.json").read_text())
    assert said["versions"]["torch"] == torch.__version__.split("+")[0] or said["versions"]["torch"]
    assert said["settings"]["quality"] == "fast" and said["settings"]["holes"] == "continue"
    assert said["settings"]["target"]["name"] == "waymo"
    sums = said["sources"]["0002"]
    assert set(sums) == {"0002/calib.json", "0002/00.jpg", "0002/01.jpg", "0002/lidar.npy"}
    for name, digest in sums.items():
        assert hashlib.sha256((source / name).read_bytes()).hexdigest() == digest
    assert said["skipped"] == {}


def test_a_report_shows_what_was_written(output: Path) -> None:
    page = (output / "conversion" / "report.html").read_text()
    assert "drive as waymo would have seen it" in page and "1 of 3 frames" in page and "converted" in page


def test_fits_and_bars(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = FrameFolder(source)[0]
    for fit in ("pad", "stretch"):
        assert main(command(source, tmp_path / fit, "--images", "png", "--fit", fit)) == 0
        after = FrameFolder(tmp_path / fit)[0]
        expected = TARGET.resized((24, 40), fit).in_frame_of(before["rig"])
        assert np.allclose(after["rig"].K, expected.K) and after["rig"][0].size == (24, 40)
        if fit == "pad":
            for camera, image, wanted in zip(after["rig"], after["images"], expected, strict=True):
                assert np.array_equal(camera.mask, wanted.mask) and not camera.mask.all()
                assert not image[:, torch.from_numpy(~camera.mask)].any()
    assert main(command(source, tmp_path / "pad", "--images", "png", "--fit", "crop")) != 0
    assert "got settings.fit 'crop' instead of 'pad'" in capsys.readouterr().err


def test_depth_from_motion_is_read(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(source, tmp_path / "drive")
    asked = command(tmp_path / "drive", tmp_path / "new", "--images", "png", "--geometry", "motion")
    assert main(asked) == 2 and "--geometry motion: expected depth in" in capsys.readouterr().err
    depths = DepthFolder(tmp_path / "drive" / "motion_depth")
    old = FrameFolder(tmp_path / "drive")
    for k, token in enumerate(old.tokens):
        rig = old[k]["rig"]
        depths.write(token, rig, MotionDepth(tuple(np.full(c.size, 6.0 + k, np.float32) for c in rig), "made"))
    assert main(asked) == 0
    retarget = RigRetarget(TARGET, size=(24, 40), geometry="motion", keys=SampleKeys(extra=("confidence",)))
    static = RigRetarget(TARGET, size=(24, 40), geometry="street")
    new, samples = FrameFolder(tmp_path / "new"), WithDepth(old, depths.root)
    for k in range(len(old)):
        assert torch.equal(new[k]["images"], retarget(samples[k])["images"])
        assert not torch.equal(new[k]["images"], static(old[k])["images"])
    read = json.loads((tmp_path / "new" / "conversion" / "provenance.json").read_text())["sources"]["0001"]
    assert "motion_depth/0001.npz" in read
    depths.path("0002").unlink()
    (tmp_path / "drive" / "motion_depth").rename(tmp_path / "elsewhere")
    moved = command(tmp_path / "drive", tmp_path / "newer", "--geometry", "motion")
    assert main([*moved, "--depth", str(tmp_path / "elsewhere")]) == 1
    assert "expected depth of frame '0002', found none" in capsys.readouterr().err
    assert (
        main(command(source, tmp_path / "other", "--geometry", "street", "--depth", str(tmp_path / "elsewhere"))) == 2
    )
    assert "expected it with --geometry auto, motion, fused, got street" in capsys.readouterr().err


def test_learned_depth_where_it_is_read(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """``auto`` was given it and did not read it; ``fused`` did not find it; with depth from motion it takes both."""
    drive, sources = shutil.copytree(source / "0000", tmp_path / "drive" / "0000").parent, {}
    rig = FrameFolder(drive)[0]["rig"]
    maps = tuple(np.full(c.size, 6.0, np.float32) for c in rig)
    for kind, folder in ((LearnedDepth, "learned_depth"), (MotionDepth, "motion_depth")):
        DepthFolder(drive / folder).write("0000", rig, kind(maps, "made"))
        assert main(command(drive, tmp_path / folder, "--geometry", "fused")) == 0
        sources[folder] = json.loads((tmp_path / folder / "conversion/samples/0000.json").read_text())["sources"]
    assert "learned_depth/0000.npz" in sources["learned_depth"] and "motion_depth/0000.npz" in sources["motion_depth"]
    assert "learned_depth/0000.npz" in sources["motion_depth"]
    for geometry in ("auto", "motion"):
        asked = command(drive, tmp_path / "new", "--geometry", geometry, "--depth", str(drive / "learned_depth"))
        assert main(asked) == 2 and f"--geometry fused, learned, got {geometry}" in capsys.readouterr().err


def test_sources_outside_of_the_root_have_names_of_their_own(source: Path, tmp_path: Path) -> None:
    """Here: of a frame that is its own root, opened by a link."""
    shutil.copytree(source / "0001", tmp_path / "0001")
    calib = json.loads((tmp_path / "0001" / "calib.json").read_text())
    for entry in calib["cameras"]:
        (tmp_path / "0001" / entry["name"]).mkdir()
        (tmp_path / "0001" / entry["file"]).rename(tmp_path / "0001" / entry["name"] / "0.jpg")
        entry["file"] = f"{entry['name']}/0.jpg"
    (tmp_path / "0001" / "calib.json").write_text(json.dumps(calib))
    (tmp_path / "link").symlink_to("0001")
    assert main(command(tmp_path / "link", tmp_path / "new")) == 0
    said = json.loads((tmp_path / "new" / "conversion" / "provenance.json").read_text())
    assert set(said["sources"]["0001"]) == {"calib.json", "lidar.npy", *(entry["file"] for entry in calib["cameras"])}


def test_what_was_broken_is_made_again(source: Path, tmp_path: Path) -> None:
    assert main(command(source, tmp_path / "new")) == 0
    before = tree(tmp_path / "new")
    (tmp_path / "new" / "0000" / "ring_front_left.jpg").write_bytes(b"cut")
    (tmp_path / "new" / "0001" / "ring_front_center.coverage.png").unlink()
    (tmp_path / "new" / "0001" / "lidar.npy").unlink()
    (tmp_path / "new" / "0002" / ".00.jpg.2-01234567-1-89abcdef.part").write_bytes(b"left behind")
    assert main(command(source, tmp_path / "new")) == 0
    assert tree(tmp_path / "new") == before


@pytest.mark.parametrize(
    ("output", "message"),
    [
        *((name, "expected a folder apart from the source") for name in ("drive", "drive/new", ".")),
        ("mine", "got thesis.tex and no conversion/settings.json"),
        ("mine/thesis.tex", "expected a folder, got a file"),
        ("\udcff", "expected a folder whose name is UTF-8"),
    ],
)
def test_outputs_that_are_refused(
    output: str, message: str, source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing is written."""
    shutil.copytree(source, tmp_path / "drive")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    before = tree(tmp_path)
    assert main(command(tmp_path / "drive", tmp_path / output)) == 2
    assert message in capsys.readouterr().err and tree(tmp_path) == before


def test_it_goes_on_as_it_was_begun(source: Path, output: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = tree(output)
    assert main(command(source, output, "--quality", "draft")) == 2
    assert "quality 'draft' instead of 'fast'" in capsys.readouterr().err
    assert tree(output) == before


def test_shards_that_begin_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With other settings: the later one is refused, although it saw none."""
    link = os.link

    def slow(*paths: Path) -> None:
        monkeypatch.setattr(os, "link", link)
        Manifest(tmp_path).begin({"settings": {"size": 256}})
        link(*paths)

    monkeypatch.setattr(os, "link", slow)
    with pytest.raises(DataError, match=r"got settings\.size 512 instead of 256"):
        Manifest(tmp_path).begin({"settings": {"size": 512}})
    assert json.loads((tmp_path / "conversion" / "settings.json").read_text())["settings"] == {"size": 256}


def test_a_frame_must_not_be_called_as_the_conversions_folder(source: Path, tmp_path: Path) -> None:
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "conversion").symlink_to(source / "0000")
    assert main(command(tmp_path / "drive", tmp_path / "new")) == 2
    assert not (tmp_path / "new").exists()
    with pytest.raises(DataError):
        FrameFolder(tmp_path / "new")


def test_nothing_stays_of_what_the_source_had(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Images swapped, a corrected calibration, other points in as many bytes or none, an image that cannot be read."""
    drive = shutil.copytree(source, tmp_path / "drive")
    asked = command(drive, tmp_path / "new", "--points", "source", "--on-error", "skip")
    assert main(asked) == 0
    front, left = (drive / "0000" / f"{k:02}.jpg" for k in range(2))
    swapped = front.read_bytes(), left.read_bytes()
    for path, content in zip((left, front), swapped, strict=True):
        path.write_bytes(content)
    shutil.copy(source / "0001" / "lidar.npy", drive / "0002")
    calib = drive / "0002" / "calib.json"
    calib.write_text(calib.read_text().replace("-0.1", "-0.2"))
    capsys.readouterr()
    assert main(asked) == 0 and "2 samples converted, 1 there before" in capsys.readouterr().out
    (drive / "0000" / "lidar.npy").unlink()
    (drive / "0001" / "00.jpg").write_bytes(b"cut")
    assert main(asked) == 0 and main(command(drive, tmp_path / "whole", *asked[-4:])) == 0
    assert tree(tmp_path / "new") == tree(tmp_path / "whole") and FrameFolder(tmp_path / "new").tokens == [
        "0000",
        "0002",
    ]


def test_a_neighbour_that_was_mended_fills_again(source: Path, tmp_path: Path) -> None:
    """A frame that could not be read is converted anew: the same bytes as undisturbed."""
    asked = ("--neighbours", "1", "--on-error", "skip")
    assert main(command(source, tmp_path / "whole", *asked)) == 0
    shutil.copytree(source, tmp_path / "drive")
    image = tmp_path / "drive" / "0000" / "00.jpg"
    sound = image.read_bytes()
    image.write_bytes(b"cut")
    assert main(command(tmp_path / "drive", tmp_path / "new", *asked)) == 0
    record = tmp_path / "new" / "conversion" / "samples" / "0001.json"
    assert json.loads(record.read_text())["without"] == ["0000"]
    image.write_bytes(sound)
    assert main(command(tmp_path / "drive", tmp_path / "new", *asked)) == 0
    assert "without" not in json.loads(record.read_text())
    assert tree(tmp_path / "new") == tree(tmp_path / "whole")


def test_records_of_other_samples_and_forms(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = command(source, tmp_path / "new")
    assert main(asked) == 0
    record = tmp_path / "new" / "conversion" / "samples" / "0000.json"
    wrote = "expected what the conversion wrote, got"
    for content, message in (
        (record.with_name("0001.json").read_text(), "expected the record of sample '0000', got that of '0001'; remove"),
        ("[]", f"{wrote} list; remove this file"),
        ("[" * 100_000, f"{wrote} maximum recursion depth exceeded"),
        (record.read_text().replace('"coverage"', '"covered"'), f"{wrote} a file that was changed; remove this file"),
        ('{"token": "0000", "skipped": 3}', f"{wrote} a file that was changed; remove this file"),
    ):
        record.write_text(content)
        assert main(asked) == 1
        said = capsys.readouterr().err
        assert f"0000: failed: {record}: {message}" in said and "0001: failed" not in said
    (tmp_path / "new" / "conversion" / "settings.json").write_text("[]")
    assert main(asked) == 2 and f"settings.json: {wrote} list" in capsys.readouterr().err


def test_images_are_not_named_as_masks(source: Path, tmp_path: Path) -> None:
    rig = FrameFolder(source)[0]["rig"]
    names = ("a", "a.coverage", "up / down")
    Rig([replace(rig[0], name=name) for name in names]).save(tmp_path / "rig.json")
    asked = command(source / "0001", tmp_path / "new", "--images", "png", "--target", str(tmp_path / "rig.json"))
    assert main(asked) == 0
    calib = json.loads((tmp_path / "new" / "0001" / "calib.json").read_text())
    files = [camera["file"] for camera in calib["cameras"]]
    assert files == ["a.png", "a%2Ecoverage.png", "up%20%2F%20down.png"]
    assert FrameFolder(tmp_path / "new")[0]["images"].shape[0] == 3
