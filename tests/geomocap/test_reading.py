"""Doors for files and names from outside: what is let in, and what is said of the rest."""

from __future__ import annotations

import io
import os
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geomocap.cli.console import PlainConsole
from geomocap.errors import CaptureError, GeomocapError, RunError, SettingsError
from geomocap.files.npz import read_arrays, read_npz
from geomocap.reading import check_name, harmless, open_plain, read_json, read_toml


def test_a_pipe_isnt_waited_for_and_a_folder_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "p.toml")
    for file, said in ((tmp_path / "p.toml", "pipe"), (tmp_path, "folder"), (tmp_path / "none", "No such file")):
        with pytest.raises(OSError, match=said):
            open_plain(file)
        with pytest.raises(SettingsError, match=said):
            read_toml(file, SettingsError)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"a = = 1", "not valid TOML"),
        (b"\xff\xfea", "no text in UTF-8"),
        (b"a = " + b"[" * 5000, "nested too deeply"),
        (b"a = " + b"1" * 5000, "thousands of digits"),
        (b"a" * (1 << 24) + b"a", "bytes, expected"),
    ],
)
def test_texts_that_are_no_toml(tmp_path, data, said):
    file = tmp_path / "a.toml"
    file.write_bytes(data)
    with pytest.raises(SettingsError, match=said) as refused:
        read_toml(file, SettingsError)
    assert str(refused.value).startswith(str(file)) and "\n" not in str(refused.value)


def test_a_byte_order_mark_is_fine(tmp_path):
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbfa = 1\r\n")
    assert read_toml(tmp_path / "a.toml", SettingsError) == {"a": 1}
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf{"a": 1}')
    assert read_json(tmp_path / "a.json", RunError) == {"a": 1}


@given(st.text())
def test_shown_text_commands_no_terminal_and_is_always_utf8(text):
    shown = harmless(text + "\x1b[2J\u202e\udcff")
    assert all(c.isprintable() or c in "\n\t" or c.isspace() for c in shown)
    shown.encode("utf-8")
    assert r"\x1b[2J\u202e\udcff" in shown
    assert "\n" not in str(GeomocapError(text + "\na"))


def test_the_console_shows_markup_as_it_is():
    console = PlainConsole(file=io.StringIO(), markup=False, emoji=False, highlight=False)
    console.print("[/b] [red]x :smile: \x1b[2J")
    assert console.file.getvalue() == "[/b] [red]x :smile: \\x1b[2J\n"


@pytest.mark.parametrize(
    "name", ["", " ", ".", "..", "../x", "a/b", "a\\b", "a\tb", "a\nb", "\x1b[2J", "x" * 101, "\udcff"]
)
def test_names_that_lead_elsewhere_or_cant_be_seen_are_refused(name):
    with pytest.raises(CaptureError, match="give it a plain name"):
        check_name(name, "a.toml", CaptureError)


@pytest.mark.parametrize("name", ["cam01", "été", "中文", "<script>", "a b", "-n", "%s", "😀", "x" * 100])
def test_unusual_names_are_names(name):
    check_name(name, "a.toml", CaptureError)


def claiming(shape: tuple[int, ...], data: bytes = b"", kind: str = "<f8") -> bytes:
    """An NPZ whose array says to be of a shape."""
    header, stream = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": kind, "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", header.getvalue() + data)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (claiming((10**12, 3)), "takes 24,000,000,000,000 bytes, 0 are there"),
        (claiming((2**70, 3)), "bytes, 0 are there"),
        (claiming((-5, 3)), "shape"),
        (claiming((2, 3), bytes(47)), "takes 48 bytes, 47 are there"),
        (claiming((1,), bytes(8), "|O"), "no plain numbers or text"),
        (b"PK\x03\x04xx", "no whole NPZ file"),
        (b"", "no whole NPZ file"),
        (b"\x93NUMPY\x01\x00v\x00" + b"{'descr': __import__('os')}".ljust(117) + b"\n", "damaged"),
    ],
)
def test_arrays_hold_what_they_claim(tmp_path, data, said):
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(RunError, match=said):
        read_npz(tmp_path / "a.npz")


def test_a_file_that_unpacks_to_gigabytes_of_nothing_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        with archive.open("a.npy", "w", force_zip64=True) as file:
            np.lib.format.write_array_header_1_0(
                file, {"descr": "|i1", "fortran_order": False, "shape": (3 * (1 << 27),)}
            )
            for _ in range(3):
                file.write(bytes(1 << 27))
    with pytest.raises(RunError, match=r"unpack to 0\.4 GB of nothing"):
        read_npz(tmp_path / "a.npz")


@given(st.integers(0, 4), st.sampled_from(["<f8", ">f4", "<i2", "|b1", "<U3", "|u1"]), st.booleans())
def test_whole_arrays_come_back_as_numpy_reads_them(tmp_path_factory, size, kind, by_column):
    file = tmp_path_factory.mktemp("a") / "a.npz"
    array = np.asarray(np.arange(size * 3).reshape(size, 3), dtype=kind, order="F" if by_column else "C")
    np.savez(file, a=array, b=np.array(3))
    found = read_arrays(file)
    assert found["a"].dtype == array.dtype and (found["a"] == array).all() and found["b"] == 3
