"""Ways to damage a file, and what reading it then must give.

`python -m tests.damaged_files SECONDS [READER[,READER…] …]` fuzzes each for so much processor time; those with commas
between share a process.
"""

from __future__ import annotations

import argparse
import faulthandler
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

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


def drawn(random: Random) -> list[tuple[str, float, object]]:
    """Draw some damages as `damages` does, some fifty times as fast and with no preference for simple ones."""
    hows: dict[str, Callable[[], object]] = {
        "cut": lambda: None,
        "flip": lambda: random.randrange(8),
        "byte": lambda: random.randrange(256),
        "put": lambda: random.choice(TOKENS),
        "over": lambda: random.choice(TOKENS),
        "zero": lambda: random.randint(1, 64),
        "drop": lambda: random.randint(1, 64),
        "double": lambda: random.randint(1, 200),
    }
    names = random.choices(list(hows), weights=[1, 4, 4, 4, 4, 2, 2, 2], k=random.randint(1, 4))
    return [(name, random.random(), hows[name]()) for name in names]


@dataclass
class Fuzzed:
    """What came of fuzzing a reader: files, seconds of processor time, kinds of answers, and damages that broke it."""

    reader: Reader
    file: Path
    whole: bytes
    random: Random
    count: int = 0
    seconds: float = 0.0
    said: dict[str, list[tuple[str, float, object]]] = field(default_factory=dict)
    broken: dict[str, list[tuple[str, float, object]]] = field(default_factory=dict)

    @classmethod
    def begin(cls, reader: Reader, folder: Path, random: Random) -> Fuzzed:
        """Make the reader's whole file, which must be read."""
        folder.mkdir()
        file = reader.make(folder)
        whole = file.read_bytes()
        assert survives(reader, file, whole) == ""
        return cls(reader, file, whole, random)

    def answer(self, done: list[tuple[str, float, object]]) -> str | None:
        """What is said of damages, numbers aside; None, and noted, if the reader breaks.

        What takes over a minute of processor time ends the process, which then tells where it was; so does what waits
        for half an hour.
        """
        faulthandler.dump_traceback_later(1800, exit=True)
        signal.setitimer(signal.ITIMER_PROF, 60)
        try:
            return re.sub(r"[-\d.e]+", "0", survives(self.reader, self.file, damaged(self.whole, done)))
        except Exception as error:  # all that is not one clear line is looked for
            frame = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{type(error).__name__} in {frame.name}, line {frame.lineno}"
            if where not in self.broken or len(done) < len(self.broken[where]):
                self.broken[where] = done
                if where not in self.said:
                    self.said[where] = []
                    traceback.print_exception(error, limit=-6)
            return None
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            faulthandler.cancel_dump_traceback_later()

    def go_on(self, seconds: float) -> None:
        """Damage the file for so long; every third time more, from damages that gave an answer not heard before."""
        begun, random = time.process_time(), self.random
        while time.process_time() - begun < seconds:
            before = random.choice(list(self.said.values())) if self.said and random.random() < 1 / 3 else []
            done = [*before, *drawn(random)]
            said = self.answer(done)
            if said is not None and len(done) <= 12:
                self.said.setdefault(said, done)
            self.count += 1
        self.seconds += time.process_time() - begun

    def smallest(self) -> list[list[tuple[str, float, object]]]:
        """The damages that broke the reader, less those that it breaks without."""
        found = []
        for done in list(self.broken.values()):
            for one in list(done):
                less = [d for d in done if d is not one]
                if less and self.answer(less) is None:
                    done = less
            found.append(done)
        return found


def fuzz(names: str, seconds: float, start: int = 0) -> int:
    """Damage the files of readers (commas between) in turns, from a seed on; return how many broke.

    `seconds` are each reader's, of processor time. Tells how many files, how many kinds of answers, and the damages to
    be put into `tests.found_damages`. What takes over 2 GB fails.
    """
    faulthandler.register(signal.SIGPROF, chain=True)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(), at_most(2 << 30):
        warnings.simplefilter("error")
        fuzzed = {
            name: Fuzzed.begin(READERS[name], Path(folder) / str(k), Random(f"{start} {name}"))
            for k, name in enumerate(names.split(","))
        }
        while (least := min(fuzzed.values(), key=lambda one: one.seconds)).seconds < seconds:
            least.go_on(min(1.0, seconds - least.seconds))
        for name, one in fuzzed.items():
            for done in one.smallest():
                print(f"BROKEN ({name!r}, {done!r}),", flush=True)  # noqa: T201
            told = f"{one.count} damaged files, {len(one.said)} answers, {one.seconds:.0f} s of processor time"
            print(f"{name}: {told}, seed {start}", flush=True)  # noqa: T201
    return sum(bool(one.broken) for one in fuzzed.values())


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
    """Fuzz readers, each in a process, or several in one; return how many processes found something."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seconds", type=float)
    parser.add_argument("reader", nargs="*", default=list(READERS), help="with commas between: they share a process")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if len(options.reader) == 1:
        return fuzz(options.reader[0], options.seconds, options.seed)
    command = [sys.executable, "-X", "faulthandler", "-m", "tests.damaged_files"]
    rest = [str(options.seconds), "--seed", str(options.seed)]
    return sum(subprocess.run([*command, *rest[:1], names, *rest[1:]]).returncode != 0 for names in options.reader)


if __name__ == "__main__":
    sys.exit(main())
