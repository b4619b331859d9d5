"""Ways to damage a file, and what reading it then must give.

`python -m tests.damaged_files SECONDS [READER]` fuzzes each that long.
"""

from __future__ import annotations

import faulthandler
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

from geomocap.errors import GeomocapError
from tests.file_readers import READERS, Reader

TOKENS = [
    b"nan", b"-1", b"0", b"1e400", b"9" * 30, b"[", b"]", b"{", b"}", b'"', b"\n", b"\0", b"\xff", b" ", b"=", b"#",
    b"../../x", b"1000000000000", b"\xff" * 8, b"\x00" * 8, b"<!DOCTYPE x>", b"!!opencv-matrix", b"- ", b"&a", b"*a",
    b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\x7f\xff\xff\xff", b"\0\0\xc0\x7f", b"1e-320",
    b"\\u0000", b"\xc3\x28", b"<![CDATA[",
]  # fmt: skip


@st.composite
def damages(draw: st.DrawFn) -> list[tuple[str, float, object]]:
    """Draw some damages: what, where (fraction of the file) and with what."""
    kinds = {
        "cut": st.none(),
        "flip": st.integers(0, 7),
        "byte": st.integers(0, 255),
        "put": st.sampled_from(TOKENS),
        "over": st.sampled_from(TOKENS),
        "zero": st.integers(1, 64),
        "drop": st.integers(1, 64),
        "double": st.integers(1, 200),
    }
    names = draw(st.lists(st.sampled_from(sorted(kinds)), min_size=1, max_size=4))
    return [(name, draw(st.floats(0, 1, exclude_max=True)), draw(kinds[name])) for name in names]


def damaged(data: bytes, done: list[tuple[str, float, object]]) -> bytes:
    """Do damages to the bytes of a file."""
    for name, where, how in done:
        at, got = int(where * len(data)), bytearray(data)
        match name, how:
            case "cut", _:
                got = got[:at]
            case "flip", int() if at < len(got):
                got[at] ^= 1 << how
            case "byte", int() if at < len(got):
                got[at] = how
            case "put", bytes():
                got[at:at] = how
            case "over", bytes():
                got[at : at + len(how)] = how
            case "zero", int():
                got[at : at + how] = bytes(len(got[at : at + how]))
            case "drop", int():
                del got[at : at + how]
            case "double", int():
                got[at:at] = got[at : at + how]
        data = bytes(got)
    return data


def survives(reader: Reader, file: Path, data: bytes) -> str:
    """Read damaged bytes: "" if something was read, else the error's line.

    Anything else than one clear line that names a file or what is in it is raised.
    """
    file.write_bytes(data)
    try:
        reader.read(file)
    except GeomocapError as error:
        said = str(error)
        assert said and "\n" not in said and len(said) < 2000, said
        assert "Traceback" not in said and "site-packages" not in said and "0x7f" not in said, said
        return said
    return ""


def fuzz(name: str, seconds: float) -> int:
    """Damage a reader's file for some seconds and return how often; the first failure is shrunk and raised.

    What takes over half a minute ends the process, which then tells where it was; what takes over 2 GB fails.
    """
    reader, end, count = READERS[name], time.monotonic() + seconds, 0
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(), at_most(2 << 30):
        warnings.simplefilter("error")
        file = reader.make(Path(folder))
        whole = file.read_bytes()
        assert survives(reader, file, whole) == ""
        while time.monotonic() < end:

            @seed(count)
            @settings(max_examples=200, deadline=None, database=None, suppress_health_check=list(HealthCheck))
            @given(damages())
            def once(done: list[tuple[str, float, object]]) -> None:
                faulthandler.dump_traceback_later(30, exit=True)
                survives(reader, file, damaged(whole, done))

            once()
            count += 200
    faulthandler.cancel_dump_traceback_later()
    return count


@contextmanager
def at_most(more: int) -> Iterator[None]:
    """Let this process take at most so many bytes more than it has."""
    has = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (has + more, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def main() -> int:
    """Fuzz readers, in a process each so that one which dies doesn't take the others along; return how many failed."""
    seconds, *chosen = sys.argv[1:]
    if len(chosen) == 1:
        print(f"{chosen[0]}: {fuzz(chosen[0], float(seconds))} damaged files", flush=True)  # noqa: T201
        return 0
    command = [sys.executable, "-X", "faulthandler", "-m", "tests.damaged_files", seconds]
    return sum(subprocess.run([*command, name]).returncode != 0 for name in chosen or READERS)


if __name__ == "__main__":
    sys.exit(main())
