"""The table of docs/exchange.md: ``python -m benchmarks.recovery [CASE ...]``."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from benchmarks.recovery.cases import CASES
from benchmarks.recovery.recover import Recovered

HEAD = (
    "| simulated by | law here | paths, typed in | paths, recovered | typed in | | "
    "recovered, relative error | of measured positions, 95 % | |\n" + "|---" * 9 + "|"
)


def main() -> None:
    names = sys.argv[1:] or list(CASES)
    print(HEAD, flush=True)
    for name in names:
        case = CASES[name]
        with tempfile.TemporaryDirectory() as folder:
            try:
                found = case.recovered(Path(folder))
            except ImportError as error:
                print(f"{name} is left out: {error}", file=sys.stderr)
                continue
        for line in rows(case.program, case.law, found):
            print(line, flush=True)


def rows(program: str, law: str, found: Recovered) -> list[str]:
    """Lines of the table, one for each parameter."""
    lines = []
    for i, name in enumerate(found.names):
        paths = [_length(found.forward), _length(found.path)]
        first = [program, law, *paths] if not i else [""] * 4
        typed, measured, half = found.typed[i], found.measured[i], found.half[i]
        last = ["", "", "not identified"]
        if found.identified[i]:
            digits, missed = _decimals(half), abs(measured - typed) > half
            value = f"{measured:.{digits}f} ± {half:.{digits}f}"
            last = [f"{found.off[i]:.0e}", value, "misses it" if missed else ""]
        lines.append(f"| {' | '.join([*first, name, f'{typed:g}', *last])} |")
    return lines


def _decimals(half: float) -> int:
    """So many that an interval has two digits."""
    return max(0, 1 - int(f"{half:e}".partition("e")[2]))


def _length(metres: float) -> str:
    for unit, size, least in (("m", 1.0, 1.0), ("cm", 1e-2, 1e-2), ("mm", 1e-3, 1e-4)):
        if metres >= least:
            return f"{metres / size:.2g} {unit}"
    return f"{metres:.0e} m"


if __name__ == "__main__":
    main()
