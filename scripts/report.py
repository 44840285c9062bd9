"""Measure the project: `python -m scripts.report NAME [OPTIONS]`, or `--all`."""

import subprocess
import sys
from pathlib import Path

from scripts.reports.run import report

CASES = Path(__file__).parent / "reports" / "cases"
NAMES = sorted(file.stem for file in CASES.glob("*.py"))


def main() -> None:
    """Runs one report, or with --all each in a process of its own; without a name, lists them."""
    first = sys.argv[1] if sys.argv[1:] else "--help"
    if first in NAMES:
        del sys.argv[1]
        report(first)
    elif first == "--all":
        lines = [[sys.executable, "-m", "scripts.report", name, *sys.argv[2:]] for name in NAMES]
        raise SystemExit(max(subprocess.run(line, check=False).returncode for line in lines))
    elif first in ("-h", "--help"):
        print(f"{__doc__}\n\nreports: {', '.join(NAMES)}")
    else:
        print(f"error: '{first:.80}' is not a report; choose from {', '.join(NAMES)}", file=sys.stderr)
        raise SystemExit(2)


if __name__ == "__main__":
    main()
