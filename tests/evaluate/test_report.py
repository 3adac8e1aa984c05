"""``report.html``: one file without any other; in a browser, where there is one, its sliders and choices work."""

from __future__ import annotations

import re

import numpy as np
import pytest

from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig, demo_target_rig
from arbiview_aug.evaluate.frames import Evaluation, evaluate, make_frame, retargeting
from arbiview_aug.evaluate.report.tables import TRUTH_COLUMNS, html_report, layers

SIZE = (48, 132)
NAMES = ["fast, street", "own & only"]


@pytest.fixture(scope="module")
def done() -> Evaluation:
    drive, target = SyntheticDrive(demo_source_rig(SIZE), num_frames=1), demo_target_rig(SIZE)
    frame = make_frame(drive[0], truth=lambda rig: drive.render(0, rig), exposures=())
    methods = [retargeting("fast", "street", NAMES[0]), retargeting("draft", "infinity", NAMES[1])]
    return evaluate([("only", frame)], lambda _: target, methods)


@pytest.fixture(scope="module")
def page(done: Evaluation) -> str:
    means = {name: done.means(name) for name in NAMES}
    return html_report("A <title> & more", done, NAMES, [("Truth", means, TRUTH_COLUMNS, "a note")], ["5 < 6"])


def test_nothing_else_is_needed(page: str) -> None:
    sources = re.findall(r'\bsrc="([^"]{0,30})', page)
    assert len(sources) > 5 * 6 and all(source.startswith("data:image/jpeg;base64,") for source in sources)
    assert "http" not in re.sub(r'src="[^"]*"', "", page) and "<link" not in page


def test_text_is_escaped_and_numbers_are_there(page: str, done: Evaluation) -> None:
    assert "A &lt;title&gt; &amp; more" in page and "5 &lt; 6" in page and "own &amp; only" in page
    assert f"{done.means(NAMES[0])['true_covered_psnr_db']:.2f}" in page
    assert page.count('class="slider"') == 5 and page.count('type="range"') == 5


def test_layers(done: Evaluation) -> None:
    shown = {name: done.pictures[name] for name in NAMES}
    found = layers(0, done, shown)
    expected = ["nearest source camera"]
    for name in NAMES:
        expected += [name] if shown[name][0].coverage.all() else [name, f"{name}: unseen"]
    assert list(found) == [*expected, "truth"]
    np.testing.assert_array_equal(found[NAMES[0]], shown[NAMES[0]][0].image)
