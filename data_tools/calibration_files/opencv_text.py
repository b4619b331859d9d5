"""OpenCV's file storage as text, read: YAML, XML and JSON, as far as calibrations use them.

OpenCV's own reader trusts its input: one that is damaged makes it crash or overwrite memory. Here a file becomes nested
dicts and lists of texts, never deeper than calibrations are.
"""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geomocap.errors import CalibrationError
from geomocap.reading import harmless, read_text, reason, shortened

DEEPEST = 16  # levels; calibrations have four
_KEY = re.compile(r"""(?:"([^"]*)"|'([^']*)'|([^\s'"\[\]{},#&*!|>%@`-][^:]*|-?[^\s:,\[\]{}]+))\s*:(?:\s+|$)(.*)""")
_TAG = re.compile(r"(?:[!&]\S*\s*)+")
_SCALAR = re.compile(r"""\s*(?:"([^"]*)"|'([^']*)'|([^,\[\]{}]*))""")


@dataclass(frozen=True)
class OpenCVFile:
    """What a file holds: the keys at its top."""

    file: Path
    content: Mapping[str, Any]

    def matrix(self, *keys: str) -> np.ndarray | None:
        """Return the first of these matrices that is there, (rows, cols) float; None if none is.

        Raises
        ------
        CalibrationError
            If it holds something that is no number, or not as many as it says.
        """
        for key in keys:
            if key in self.content:
                return self._as_matrix(key, self.content[key])
        return None

    def number(self, key: str) -> int:
        """Return a whole number; 0 if it isn't there."""
        if key not in self.content:
            return 0
        try:
            return int(float(self.content[key]))
        except (TypeError, ValueError, OverflowError):
            raise CalibrationError(f"{self.file}: {key} is no number") from None

    def texts(self, key: str) -> list[str]:
        """Return a list of texts; empty if there is none."""
        found = self.content.get(key)
        if isinstance(found, str):  # XML writes them one after the other
            return [a or b for a, b in re.findall(r'"([^"]*)"|(\S+)', found)]
        return [t for t in found if isinstance(t, str)] if isinstance(found, list) else []

    def _as_matrix(self, key: str, node: Any) -> np.ndarray:
        shape: tuple[int, ...] | None = None
        values = node
        try:
            if isinstance(node, dict):
                shape, values = (int(node["rows"]), int(node["cols"])), node["data"]
            if isinstance(values, str):
                values = values.split()
            array = np.array(values, dtype=np.float64)
        except (KeyError, TypeError, ValueError, OverflowError):
            raise CalibrationError(f"{self.file}: {key} is no matrix of numbers") from None
        if shape is None:
            return array
        if array.size != shape[0] * shape[1] or min(shape) < 1:
            raise CalibrationError(f"{self.file}: {key} has {array.size} numbers for {shape[0]}×{shape[1]}")
        return array.reshape(shape)


def read_opencv_file(file: Path) -> OpenCVFile:
    """Read a file of OpenCV's.

    Raises
    ------
    CalibrationError
        If it can't be read, or is none.
    """
    text = read_text(file, CalibrationError, "give a calibration file")
    start = text.lstrip()[:1]
    try:
        if start == "<":
            content = _xml(text)
        elif start == "{":
            content = _json(json.loads(text), 0)
        else:
            content = _Lines.of(text).whole()
    except (ValueError, ElementTree.ParseError, RecursionError) as error:
        raise CalibrationError(f"{file}: no readable OpenCV file ({reason(error)})") from None
    if not isinstance(content, dict):
        raise CalibrationError(f"{file}: no readable OpenCV file (it has no keys)")
    return OpenCVFile(file, content)


# --- XML and JSON ---


def _xml(text: str) -> Any:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("a document type or entities, which OpenCV never writes")
    return _element(ElementTree.fromstring(text), 0)


def _element(node: ElementTree.Element, depth: int) -> Any:
    if depth > DEEPEST:
        raise ValueError("nested too deeply")
    if len(node) == 0:
        return (node.text or "").strip()
    if all(child.tag == "_" for child in node):
        return [_element(child, depth + 1) for child in node]
    return {child.tag: _element(child, depth + 1) for child in node}


def _json(value: Any, depth: int) -> Any:
    if depth > DEEPEST:
        raise ValueError("nested too deeply")
    if isinstance(value, dict):
        return {key: _json(v, depth + 1) for key, v in value.items()}
    return [_json(v, depth + 1) for v in value] if isinstance(value, list) else str(value)


# --- YAML ---


@dataclass
class _Lines:
    """Lines of YAML that say something: indentation and text; `at` is the next one."""

    lines: list[tuple[int, str, int]]
    at: int = 0

    @classmethod
    def of(cls, text: str) -> _Lines:
        found = []
        for number, line in enumerate(text.splitlines(), start=1):
            plain = re.sub(r"(^|\s)#.*$", "", line) if "#" in line and not re.search(r"""["'].*#""", line) else line
            if plain.strip() and not plain.startswith(("%", "---", "...")):
                found.append((len(plain) - len(plain.lstrip()), plain.strip(), number))
        return cls(found)

    def whole(self) -> Any:
        """Read all lines."""
        found = self.block(0, 0)
        if self.at < len(self.lines):
            raise ValueError(f"line {self.lines[self.at][2]}: its indentation is wrong")
        return found

    def block(self, indent: int, depth: int) -> Any:
        """Read what stands at this indentation or deeper: keys, items, or one value."""
        if depth > DEEPEST:
            raise ValueError("nested too deeply")
        if self.at >= len(self.lines):
            return {}
        own = self.lines[self.at][0]
        if self.lines[self.at][1][:2] in ("-", "- "):
            return self._items(own, depth)
        keys: dict[str, Any] = {}
        while self.at < len(self.lines) and self.lines[self.at][0] == own >= indent:
            _, text, number = self.lines[self.at]
            match = _KEY.fullmatch(text)
            if match is None:
                raise ValueError(f"line {number}: expected KEY: VALUE, got '{harmless(shortened(text, 40))}'")
            self.at += 1
            key = next(g for g in match.groups()[:3] if g is not None).strip()
            keys[key] = self._value(match[4], own, depth)
        if self.at < len(self.lines) and self.lines[self.at][0] > own:
            raise ValueError(f"line {self.lines[self.at][2]}: its indentation is wrong")
        return keys

    def _items(self, own: int, depth: int) -> list[Any]:
        items = []
        while self.at < len(self.lines) and self.lines[self.at][0] == own and self.lines[self.at][1][:2] in ("-", "- "):
            text = self.lines[self.at][1][1:].strip()
            self.at += 1
            items.append(self._value(text, own, depth))
        return items

    def _value(self, text: str, own: int, depth: int) -> Any:
        """Read the value that begins with the rest of a line."""
        text = _TAG.sub("", text, count=1) if text[:1] in "!&" and text else text
        if text[:1] in ("[", "{") and text:
            while self.at < len(self.lines) and _open_brackets(text) > 0:
                text += " " + self.lines[self.at][1]
                self.at += 1
            value, end = _flow(text, 0, depth + 1)
            if text[end:].strip():
                raise ValueError(f"'{harmless(shortened(text[end:].strip(), 40))}' behind a closed list")
            return value
        if text[:1] in ("|", ">") and text:
            while self.at < len(self.lines) and self.lines[self.at][0] > own:
                self.at += 1
            return ""
        if text:
            return _unquoted(text)
        following = self.lines[self.at] if self.at < len(self.lines) else (-1, "", 0)
        if following[0] > own or (following[0] == own and following[1][:2] in ("-", "- ")):
            return self.block(own, depth + 1)
        return ""


def _open_brackets(text: str) -> int:
    bare = re.sub(r"""\"[^"]*\"|'[^']*'""", "", text)
    return sum(bare.count(c) for c in "[{") - sum(bare.count(c) for c in "]}")


def _flow(text: str, at: int, depth: int) -> tuple[Any, int]:
    """Read a list or map in brackets; the value, and where it ends."""
    if depth > DEEPEST:
        raise ValueError("nested too deeply")
    closing, items = {"[": "]", "{": "}"}[text[at]], list[Any]()
    at += 1
    while True:
        while at < len(text) and text[at] in " \t,":
            at += 1
        if at >= len(text):
            raise ValueError(f"a bracket isn't closed, {closing} is missing")
        if text[at] == closing:
            return (items if closing == "]" else _pairs(items)), at + 1
        if text[at] in "[{":
            value, at = _flow(text, at, depth + 1)
        else:
            match = _SCALAR.match(text, at)
            if match is None or match.end() == at:
                raise ValueError(f"'{text[at]}' where {closing} is expected")
            value, at = next(g for g in match.groups() if g is not None).strip(), match.end()
        items.append(value)


def _pairs(items: list[Any]) -> dict[str, Any]:
    """Pairs of a map in brackets, as far as they are single values."""
    found = (item.partition(":") for item in items if isinstance(item, str))
    return {key.strip(): value.strip() for key, _, value in found}


def _unquoted(text: str) -> str:
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] and text[0] in "\"'" else text
