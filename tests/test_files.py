import os
from collections.abc import Callable
from pathlib import Path

import pytest

from arbiview_aug.errors import ArbiviewError, GeneratorError
from arbiview_aug.files import read_bytes, read_text
from arbiview_aug.generator.completion import load_inpainter
from arbiview_aug.generator.generator import FILE, load_part, read_checkpoint
from arbiview_aug.generator.training.losses import load_perceptual
from arbiview_aug.inpaint import PipelineInpainter
from arbiview_aug.inpaint.networks import load_torchscript
from arbiview_aug.temporal.learned_depth import TransformersDepth


def test_a_byte_order_mark_is_dropped(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"\xef\xbb\xbf{}\r\n")
    assert read_text(tmp_path / "file", 100) == "{}\r\n"


def with_pipe(folder: Path, name: str = "config.json") -> Path:
    os.mkfifo(folder / name)
    return folder


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    "load",
    [
        lambda folder: load_inpainter(with_pipe(folder, "model_index.json")),
        lambda folder: PipelineInpainter.from_pretrained(with_pipe(folder)),
        lambda folder: read_checkpoint(with_pipe(folder, FILE)),
        lambda folder: load_torchscript(with_pipe(folder) / "config.json", "network", GeneratorError),
        lambda folder: TransformersDepth(str(with_pipe(folder))),
        lambda folder: load_part("AutoencoderKL", with_pipe(folder), "vae", {}),
        lambda folder: load_perceptual(with_pipe(folder) / "config.json"),
    ],
    ids=["generator", "pipeline", "weights", "TorchScript", "depth", "diffusers", "VGG"],
)
def test_pipes_among_weights_are_refused(load: Callable[[Path], object], tmp_path: Path) -> None:
    """They would be waited for."""
    with pytest.raises(ArbiviewError, match=r"pipe|expected a generator's folder"):
        load(tmp_path)


@pytest.mark.parametrize(
    ("name", "message"),
    [("pipe", "pipe"), ("folder", "folder"), ("large", "2.0 MiB, more than 1.0 MiB"), ("loop", "links"),
     ("none", "No such file"), ("a\0b", "no file can have"), ("\ud800", "no file can have"), ("x" * 300, "too long")],
)  # fmt: skip
def test_what_is_no_regular_file_of_bounded_size_is_an_os_error(tmp_path: Path, name: str, message: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "large").write_bytes(bytes(2 << 20))
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(OSError, match=message):
        read_bytes(tmp_path / name, 1 << 20)
