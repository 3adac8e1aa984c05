import os
from pathlib import Path

import pytest

from arbiview_aug.files import read_bytes, read_text


def test_a_byte_order_mark_is_dropped(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"\xef\xbb\xbf{}\r\n")
    assert read_text(tmp_path / "file", 100) == "{}\r\n"


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
