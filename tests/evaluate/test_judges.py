"""Judges by the names of their options: stubs in files, and refusals that name option, file and fix."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.judges import load_detector, load_segmenter

IMAGE = np.random.default_rng(0).integers(0, 256, (90, 160, 3), np.uint8)


@pytest.fixture
def file(tmp_path: Path) -> Callable[[str], str]:
    """Write a file with a function ``judge`` that returns an expression, and name it as the options do."""

    def write(expression: str, head: str = "import numpy as np, torch") -> str:
        (tmp_path / "own.py").write_text(f"{head}\ndef judge(rgb):\n    return {expression}\nnumber = 3\n")
        return f"{tmp_path / 'own.py'}:judge"

    return write


# --- functions --------------------------------------------------------------------------------------------------------
def test_a_function_of_a_file(file: Callable[[str], str]) -> None:
    found = load_detector(file("torch.tensor([[-5.0, 2, 200, 50], [1, 2, 3, 4]]), np.array([0.9, 0.04])"))(IMAGE)
    assert found.boxes.tolist() == [[0, 2, 160, 50]], "cut at the border; an unsure one does not count"
    assert found.scores.tolist() == [0.9]
    nothing = load_detector(file("[], []"))(IMAGE)
    assert nothing.boxes.shape == (0, 4) and nothing.scores.shape == (0,)


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ("np.zeros((3, 4))", "expected boxes (n, 4) x0 y0 x1 y1 and scores (n,) for an image (90, 160, 3), "),
        ("[[1, 2, 3]], [0.5]", "got (1, 3) and (1,)"),
        ("[[1, 2, 3, 4]], [0.5, 0.4]", "got (1, 4) and (2,)"),
        ("[[1, 2, 3, 4]], [0.5], ['car']", "got other values"),
        ("[[1, 2, float('nan'), 4]], [0.5]", "finite, with x0 <= x1 and y0 <= y1, got [1.0, 2.0, nan, 4.0]"),
        ("[[9, 2, 3, 4]], [0.5]", "finite, with x0 <= x1 and y0 <= y1, got [9.0, 2.0, 3.0, 4.0]"),
        ("[[1, 2, 3, 4]], [50]", "scores from 0 to 1, got [50.0]"),
        ("'abc', [0.5]", "got other values"),
        ("[torch.ones(4, requires_grad=True)], [0.5]", "got other values"),
        ("rgb.missing", "for an image (90, 160, 3) uint8 it raised AttributeError: 'numpy.ndarray' object has no attr"),
        ("exit(0)", "it raised SystemExit: 0"),
        ("(_ for _ in ()).throw(GeneratorExit)", "raised GeneratorExit"),
    ],
)
def test_detections_of_other_shapes(file: Callable[[str], str], expression: str, message: str) -> None:
    name = file(expression)
    with pytest.raises(DataError, match=re.escape(f"--detector {name}: ") + ".*" + re.escape(message)):
        load_detector(name)(IMAGE)


@pytest.mark.parametrize("load", [load_detector, load_segmenter])
def test_files_without_a_function(load: Callable[[str], object], file: Callable[..., str], tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"expected a file .*none\.py, found none"):
        load(f"{tmp_path}/none.py:judge")
    name = file("1")
    with pytest.raises(DataError, match=r"expected FILE.py:function, found no function's name; add it"):
        load(name.removesuffix(":judge"))
    for missing in ("missing", "number"):
        with pytest.raises(DataError, match=rf"expected a function {missing} in .*own\.py, found \['judge'\]"):
            load(name.replace(":judge", f":{missing}"))
    with pytest.raises(DataError, match=r"importing .*own\.py raised ModuleNotFoundError: No module named 'nowhere'"):
        load(file("1", "import nowhere"))
    for head, raised in (  # of different lengths: bytecode of the same second is told by the size
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("raise GeneratorExit()", "GeneratorExit"),
        ("def __getattr__(name): exit(0)", "SystemExit: 0"),
    ):
        with pytest.raises(DataError, match=rf"importing .*own\.py raised {raised}"):
            load(file("1", head).replace(":judge", ":missing" if "getattr" in head else ":judge"))


def test_a_segmenter_of_a_file(file: Callable[[str], str]) -> None:
    masks = load_segmenter(file("np.stack([rgb[..., 0] > 9, rgb[..., 1] > 9])"))(IMAGE)
    assert masks.dtype == np.bool_ and np.array_equal(masks, IMAGE.transpose(2, 0, 1)[:2] > 9)
    with pytest.raises(DataError, match=r"--segmenter .*: for an image .* it raised SystemExit: 0"):
        load_segmenter(file("exit(0)"))(IMAGE)
    wrong_ones = {"rgb[..., 0] > 9": "bool (90, 160)", "rgb.transpose(2, 0, 1)": "uint8", "None": "NoneType"}
    for wrong, got in wrong_ones.items():
        with pytest.raises(
            DataError, match=r"--segmenter .*expected masks \(n, 90, 160\) of 0 and 1, got " + re.escape(got)
        ):
            load_segmenter(file(wrong))(IMAGE)
