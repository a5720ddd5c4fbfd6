"""Benchmarks print tables."""

from collections.abc import Sequence


def print_table(
    title: str, head: Sequence[object], rows: Sequence[Sequence[object]], note: str = ""
) -> None:
    """Print a table with a title above and a note below."""
    lines = [[str(cell) for cell in line] for line in (head, *rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    print(f"\n{title}")
    for line in lines:
        print("  " + "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)))
    if note:
        print(f"  {note}")
