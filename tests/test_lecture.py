"""The notebooks as a lecture: every equation of the paper once; that exercises run is seen in test_golden.py."""

import re

from notebook_runs import NOTEBOOKS, read

LECTURE = [
    path for path in NOTEBOOKS if path.stem[:2] in ("00", "01", "02", "03", "04", "05")
]


def texts(path):
    return [cell.source for cell in read(path).cells if cell.cell_type == "markdown"]


def test_every_equation_of_the_paper_stands_once():
    tags = [
        int(n)
        for path in LECTURE
        for text in texts(path)
        for n in re.findall(r"\\tag\{(\d+)\}", text)
    ]
    assert sorted(tags) == list(range(1, 22))
