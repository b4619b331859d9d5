"""The page of results, made from measured figures: `python -m tools.results_page`.

Reads `docs/results/*.toml` and writes `docs/results.md`, and the small table of the README between its two marks.
"""

from __future__ import annotations

from pathlib import Path

from geomocap.files.atomic import write_text
from tools.result_tables import MEASURED, ROOT, ResultTable, read_tables

BEGIN, END = "<!-- results: python -m tools.results_page -->", "<!-- end of results -->"
HEAD = """\
<!-- Made by `python -m tools.results_page` from docs/results/*.toml: change those. -->

# Results

Every figure here was measured, with the commit, seed and command that its table states. Run a command again to check
it; `python -m tests.benchmarks.quality FOLDER --results docs/results/whole-runs.toml` writes rows of the first table.
"""


def results_page(tables: list[ResultTable]) -> str:
    """Write the whole page."""
    return "\n".join([HEAD, *(section(table) for table in tables)])


def section(table: ResultTable) -> str:
    """Write a table with its text and where its rows come from."""
    values = table.values
    parts = [f"## {values['title']}", values.get("about", "").strip(), markdown(table), provenance(table)]
    return "\n\n".join(part for part in [*parts, values.get("notes", "").strip()] if part) + "\n"


def markdown(table: ResultTable, names: list[str] | None = None, labels: list[str] | None = None) -> str:
    """Write rows and columns, all if none are named, as a Markdown table."""
    columns = [c for c in table.values["columns"] if labels is None or c["label"] in labels]
    rows = [r for r in table.values["rows"] if names is None or r["name"] in names]
    lines = [[c["label"] for c in columns], ["---"] * len(columns), *(table.cells(r, columns) for r in rows)]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def provenance(table: ResultTable) -> str:
    """Say with which commit, seed and command the rows were measured, rows of one origin together."""
    origins: dict[tuple[str, ...], list[str]] = {}
    for row in table.values["rows"]:
        said = table.row(row)
        origin = (*(str(said[key]) for key in MEASURED), said.get("note", ""))
        origins.setdefault(origin, []).append(row["name"])
    most = max(origins, key=lambda origin: len(origins[origin]))
    lines = []
    for origin, names in origins.items():
        commit, seed, day, command, note = origin
        which = ("All rows" if len(origins) == 1 else "All other rows") if origin == most else "; ".join(names)
        lines.append(
            (origin == most, f"{which}: commit {commit}, {day}, seed {seed}, `{command}`{', ' * bool(note)}{note}")
        )
    return "*Measured.* " + ".\n".join(line for _, line in sorted(lines, key=lambda line: line[0])) + "."


def with_table(readme: str, tables: list[ResultTable]) -> str:
    """Return the README with its small table made anew."""
    table = next(t for t in tables if "readme" in t.values)
    shown = table.values["readme"]
    before, rest = readme.split(BEGIN)
    return f"{before}{BEGIN}\n{markdown(table, shown['rows'], shown['columns'])}\n{END}{rest.split(END)[1]}"


def main() -> None:
    """Write the page and the README's table."""
    tables = read_tables(ROOT / "docs" / "results")
    write_text(ROOT / "docs" / "results.md", results_page(tables))
    readme: Path = ROOT / "README.md"
    write_text(readme, with_table(readme.read_text(encoding="utf-8"), tables))


if __name__ == "__main__":
    main()
