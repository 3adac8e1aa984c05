"""Interrupted work leaves nothing half done, and goes on to the same frames."""

import sys

import numpy as np
import pytest

from integrations.cross_rig import cache
from integrations.cross_rig.cache import FrameStore, code_hash, content_hash, fill
from integrations.cross_rig.frames import Source
from integrations.cross_rig.variants import VARIANTS


@pytest.fixture(autouse=True)
def _short_chunks(monkeypatch):
    monkeypatch.setattr(cache, "CHUNK_FRAMES", 4)


def make(index: int) -> dict[str, np.ndarray]:
    return {"images": np.full((2, 3), index, np.uint8), "cpu_s": np.float32(index)}


def test_resumed_equals_uninterrupted(tmp_path):
    whole, store = (FrameStore(tmp_path / name, {"a": 1}) for name in ("whole", "killed"))

    def dying(index: int) -> dict[str, np.ndarray]:
        if index == 6:
            raise KeyboardInterrupt
        return make(index)

    assert store.missing(9) == [0, 1, 2]
    fill(store, dying, 0)
    with pytest.raises(KeyboardInterrupt):
        fill(store, dying, 1)
    assert store.missing(9) == [1, 2]
    # A process that dies while it writes leaves a part.
    part = store.folder / ".part-1-died"
    part.mkdir(parents=True)
    (part / "images.npy").write_bytes(b"half")
    again = FrameStore(tmp_path / "killed", {"a": 1})
    for chunk in again.missing(9):
        fill(again, make, chunk)
    for chunk in whole.missing(9):
        fill(whole, make, chunk)
    for index in range(9):
        np.testing.assert_array_equal(again.read(index, "images"), whole.read(index, "images"))
    np.testing.assert_array_equal(again.stacked("cpu_s", 9), np.arange(9, dtype=np.float32))
    assert list(again.folder.glob(".part*")) == [part]


def test_two_processes_make_one_chunk(tmp_path, monkeypatch):
    one, two, save = FrameStore(tmp_path, {"a": 1}), FrameStore(tmp_path, {"a": 1}), np.save

    def beside(path, array):
        monkeypatch.setattr(np, "save", save)
        save(path, array)
        fill(two, make, 0)

    monkeypatch.setattr(np, "save", beside)
    fill(one, make, 0)
    assert one.missing(4) == [] and not list(one.folder.glob(".part*"))
    np.testing.assert_array_equal(one.stacked("cpu_s", 4), np.arange(4))


def test_a_set_grows_and_images_are_mapped(tmp_path):
    store = FrameStore(tmp_path, {"a": 1})
    fill(store, make, 0)
    assert store.missing(4) == [] and store.missing(5) == [1]
    store.read(3, "images")
    assert isinstance(store._open[0, "images"], np.memmap)


def test_what_made_the_frames_names_them(tmp_path):
    assert FrameStore(tmp_path, {"a": 1, "b": 2}).folder == FrameStore(tmp_path, {"b": 2, "a": 1}).folder
    assert content_hash({"a": 1}) != content_hash({"a": 2})


def test_code_hash_follows_imports_and_ignores_words(tmp_path, monkeypatch):
    package = tmp_path / "hashed_package"
    package.mkdir()
    (package / "low.py").write_text("X = 1\n")
    (package / "beside.py").write_text("Y = 1\n")
    (package / "top.py").write_text('"""Words."""\nimport numpy\nfrom hashed_package.low import X\n')
    monkeypatch.syspath_prepend(str(tmp_path))

    def fresh() -> str:
        code_hash.cache_clear()
        for name in [n for n in sys.modules if n.startswith("hashed_package")]:
            del sys.modules[name]
        return code_hash("hashed_package.top")

    before = fresh()
    (package / "top.py").write_text('"""Other words."""\n\nimport numpy\nfrom hashed_package.low import X  # why\n')
    (package / "beside.py").write_text("Y = 2\n")
    assert fresh() == before
    (package / "low.py").write_text('X = 2\n"""Documented."""\n')
    assert fresh() != before
    alone = code_hash("hashed_package.top", within="hashed_package.top")
    (package / "low.py").write_text("X = 3\n")
    code_hash.cache_clear()
    assert code_hash("hashed_package.top", within="hashed_package.top") == alone
    code_hash.cache_clear()


@pytest.mark.slow
def test_frames_are_made_anew_when_the_renderer_changes(tmp_path, monkeypatch):
    """Kernels, shapes and fills are part of what names a variant's frames."""
    read = set()
    source = cache._source
    monkeypatch.setattr(cache, "_source", lambda name: (read.add(name), source(name))[1])
    code_hash.cache_clear()
    for name in ("auto", "auto_fill"):
        read.clear()
        Source(root=tmp_path, size=(24, 64), split="train", change="up70", variant=VARIANTS[name]).store()
        rendering = {
            *("arbiview_aug.render.kernels", "arbiview_aug.scene.boxes"),
            *("arbiview_aug.transforms.rig_retarget", "arbiview_aug.inpaint.inpainter"),
        }
        assert rendering <= read and "arbiview_aug.datasets.synthetic.street" in read
        assert ("arbiview_aug.inpaint.continued" in read) == (name == "auto_fill")
        code_hash.cache_clear()
