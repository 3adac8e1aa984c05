"""``report.html``: one file without any other; in a browser, where there is one, its sliders and choices work."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig, demo_target_rig
from arbiview_aug.evaluate.frames import Evaluation, evaluate, make_frame
from arbiview_aug.evaluate.images import RenderedView
from arbiview_aug.evaluate.methods import Method, retargeting
from arbiview_aug.evaluate.report.html import html_report, layers
from arbiview_aug.evaluate.report.pictures import overlay_confidence
from arbiview_aug.evaluate.report.tables import TRUTH_COLUMNS

SIZE = (48, 132)
NAMES = ["fast, street", "own & only"]


def halfway_sure(sample: dict, target: Rig) -> list[RenderedView]:
    """A renderer that tells a confidence."""
    views = retargeting("draft", "infinity").render(sample, target)
    return [RenderedView(v.image, v.coverage, np.full(v.coverage.shape, 0.5, np.float32)) for v in views]


@pytest.fixture(scope="module")
def done() -> Evaluation:
    drive, target = SyntheticDrive(demo_source_rig(SIZE), num_frames=1), demo_target_rig(SIZE)
    frame = make_frame(drive[0], truth=lambda rig: drive.render(0, rig), exposures=())
    methods = [retargeting("fast", "street", NAMES[0]), Method(NAMES[1], halfway_sure)]
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
    assert list(found) == [*expected, f"{NAMES[1]}: confidence", "truth"]
    np.testing.assert_array_equal(found[NAMES[0]], shown[NAMES[0]][0].image)


def test_confidence_colours() -> None:
    grey = np.full((1, 3, 3), 100, np.uint8)
    red, yellow, green = overlay_confidence(grey, np.array([[0.0, 0.5, 1.0]]))[0].astype(int)
    assert red.tolist() == [178, 50, 50] and green.tolist() == [50, 178, 50] and yellow.tolist() == [178, 178, 50]


PROBE = """<script>
const range = document.querySelector('input[type=range]'), slider = range.previousElementSibling;
const look = side => slider.querySelectorAll('img.' + side + '[data-layer]');
const before = [...look('before')].map(i => i.dataset.layer), after = [...look('after')].map(i => i.dataset.layer);
const clip = getComputedStyle(look('before')[0]).clipPath, drawn = look('before')[0].naturalWidth;
range.value = 20; range.dispatchEvent(new Event('input'));
const moved = getComputedStyle(look('before')[0]).clipPath;
const choice = document.querySelector('select[data-side=before]');
choice.value = 'nearest source camera'; choice.dispatchEvent(new Event('change'));
const chosen = [...look('before')].map(i => i.dataset.layer);
document.title = 'PROBE ' + JSON.stringify([before, after, clip, moved, chosen, drawn]);
</script>"""


def browser() -> str:
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if (path := shutil.which(name)) is not None:
            return path
    pytest.skip("no Chromium: Debian's package chromium has it")


def test_sliders_and_choices(page: str, tmp_path: Path) -> None:
    program = browser()
    (tmp_path / "report.html").write_text(page.replace("</body>", f"{PROBE}</body>"), encoding="utf-8")
    done = subprocess.run(
        [
            program,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            f"--user-data-dir={tmp_path / 'profile'}",
            "--dump-dom",
            (tmp_path / "report.html").as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=500,
    )
    (found,) = re.findall(r"<title>PROBE (.*?)</title>", done.stdout)
    before, after, clip, moved, chosen, width = json.loads(found)
    assert before == ["truth"] and after == [NAMES[0]], "one layer on each side"
    assert "50%" in clip and "80%" in moved, "the slider at 20 hides the right four fifths of the left layer"
    assert chosen == ["nearest source camera"] and width == SIZE[1]
