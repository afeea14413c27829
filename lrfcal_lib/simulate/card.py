"""The data card: SHA-256 sums of the shipped sessions, in a file for ``sha256sum -c`` and as a table in the README."""

from __future__ import annotations

import hashlib
from pathlib import Path

SUMS = "SHA256SUMS"
BEGIN, END = "<!-- sums -->", "<!-- end of sums -->"
SMALL = ("session.json", "lrf/telegrams.bin", "lrf/index.csv", "platform.csv", "images.csv", "truth.json")


def write_card(folder, names):
    """Write the sums of sessions and the table of the data card.

    Parameters
    ----------
    folder : path-like
        Holds the sessions and a README.md with the two marks between which the table stands.
    names : sequence of str
        Folders of the sessions.

    Raises
    ------
    ValueError
        If the README has no marks.
    """
    folder = Path(folder)
    files = sorted(f for name in names for f in (folder / name).rglob("*") if f.is_file())
    sums = {f.relative_to(folder).as_posix(): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}
    listing = "".join(f"{value}  {name}\n" for name, value in sums.items())
    readme = (folder / "README.md").read_text()
    before, first, rest = readme.partition(BEGIN)
    _, last, after = rest.partition(END)
    if not (first and last):
        raise ValueError(f"{folder / 'README.md'}: put the marks '{BEGIN}' and '{END}' around the table of sums")
    (folder / SUMS).write_text(listing)
    (folder / "README.md").write_text(f"{before}{BEGIN}\n{_table(folder, names, sums, listing)}{END}{after}")


def _table(folder, names, sums, listing):
    rows = ["| file | bytes | SHA-256 |", "|---|---|---|"]
    for name in names:
        rows += [f"| {name}/{f} | {(folder / name / f).stat().st_size} | `{sums[f'{name}/{f}']}` |" for f in SMALL]
        images = {f: s for f, s in sums.items() if f.startswith(f"{name}/images/")}
        joint = hashlib.sha256("".join(f"{s}  {f}\n" for f, s in images.items()).encode()).hexdigest()
        size = sum((folder / f).stat().st_size for f in images)
        rows.append(f"| {name}/images, {len(images)} files (sum of their lines in {SUMS}) | {size} | `{joint}` |")
    rows.append(f"| {SUMS} | {len(listing)} | `{hashlib.sha256(listing.encode()).hexdigest()}` |")
    return "\n".join(rows) + "\n"
