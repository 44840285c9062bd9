"""Measure the project: `python -m scripts.report NAME [OPTIONS]`, or `--all`; `--docs [FOLDER]` fills docs/results.md.

--docs takes the numbers of all reports below FOLDER (default: runs), of the later ones where two have the same number,
and none of --quick. A comment in the page names the table below it, as REPORT/TABLE. For each table,
reports/tables.json has the cells of a row, and what * stands for in each row; or what it stands for in each column, and
the cell of each row:

    "arm/letters": [
      ["{*/letters torque_mse} / {published */letters torque_mse}", "{*/swings vpt_seconds:.1f}"],
      ["structured-delan", "black-box-delan"]
    ]

Header and first column are the page's own, and so is a cell whose first number was not measured. What follows a slash
is left out if it has no number.
"""

import os
import re
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from dln_jax.errors import InputError
from dln_jax.files import read_json, write_bytes
from dln_jax.runs.running import as_one_line
from scripts.reports.run import REMEDY, report

NAMES = sorted(file.stem for file in Path(__file__).parent.glob("reports/cases/*.py"))
PAGE = Path(__file__).parents[1] / "docs" / "results.md"
TEMPLATES = read_json(Path(__file__).parent / "reports" / "tables.json", remedy=REMEDY)
TABLE = re.compile(r"<!-- ((\w+)/\S+) -->\n\n?((?: *\|.*\n)+)")
NUMBER = re.compile(r"\{(published )?(.+?)(?::(.+?))?\}")
Numbers = dict[str, dict]
"""Rows of a report as stored, by "ROW QUANTITY"."""


def main() -> None:
    """Runs one report, with --all each in a process of its own; fills the page; without a name, lists the reports."""
    first, *rest = sys.argv[1:] or ["--help"]
    if first in NAMES:
        del sys.argv[1]
        return report(first)
    with as_one_line("python -m scripts.report", None):
        if first == "--all":
            command = sys.executable, "-m", "scripts.report"
            raise SystemExit(max(subprocess.run([*command, name, *rest]).returncode for name in NAMES))
        if first == "--docs":
            write_bytes(PAGE, fill_page(PAGE.read_text(), measured_below(Path(rest[0] if rest else "runs"))).encode())
        elif first in ("-h", "--help"):
            print(f"{__doc__}\nreports: {', '.join(NAMES)}")
        else:
            raise InputError(f"'{first:.80}' is not a report; choose from {', '.join(NAMES)}")


def measured_below(folder: Path) -> dict[str, Numbers]:
    """The numbers of all reports below a folder, by report; prints what it reads.

    Raises:
        InputError: the folder has no report.
    """
    measured: dict[str, Numbers] = {name: {} for name in NAMES}
    for path in sorted(folder.rglob("report.json"), key=os.path.getmtime):
        stored = read_json(path, remedy=REMEDY)
        facts = stored.get("conditions", {})
        name = facts.get("report")
        if name in NAMES and not facts["quick"]:
            measured[name] |= {f"{row['case']} {row['quantity']}": row for row in stored["rows"]}
            print(path)
    if not any(measured.values()):
        raise InputError(f"{folder} has no report; expected folders of python -m scripts.report NAME, without --quick")
    return measured


def fill_page(page: str, measured: dict[str, Numbers]) -> str:
    """The page with measured numbers in its tables; a table must have the rows and columns of its template."""

    def fill_table(table):
        key, name, lines = table.groups()
        across, down = TEMPLATES[key]
        header, rule, *rows = lines.splitlines()
        filled = [header, rule]
        for key, row in zip(down, rows, strict=True):
            label, *texts = (cell.strip() for cell in row.strip().strip("|").split("|"))
            for place, word in enumerate(across):
                keys = (key, word) if "{" in key else (word, key)
                texts[place] = fill_cell(texts[place], *keys, measured[name])
            filled.append(f"{row[: row.index('|')]}| {' | '.join([label, *texts])} |")
        return table[0].removesuffix(lines) + "\n".join(filled) + "\n"

    return TABLE.sub(fill_table, page)


def fill_cell(text: str, template: str, row: str, numbers: Numbers) -> str:
    """The parts of a template up to a number that was not measured; the text as it stands if it is in the first."""

    def shown(number):
        published, name, form = number.groups()
        value = numbers[name.replace("*", row)]["reference" if published else "value"]
        if value is None and not published:
            return "not finite"
        return format(value, form or ".2g").replace("e-0", "e-").replace("e+0", "e")

    parts = []
    with suppress(KeyError, TypeError):
        for part in template.split(" / "):
            parts.append(NUMBER.sub(shown, part))
    return " / ".join(parts) or text


if __name__ == "__main__":
    main()
