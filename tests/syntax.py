"""How much code there is and how densely it is packed, counted by syntax: squeezing lines together gains nothing."""

import ast
import io
import statistics
import tokenize
from collections import Counter
from dataclasses import dataclass

UNCOUNTED = (
    ast.expr_context,
    ast.operator,
    ast.cmpop,
    ast.boolop,
    ast.unaryop,
    ast.arguments,
    ast.arg,
    ast.alias,
    ast.keyword,
)
NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
DOCUMENTED = (ast.Module, ast.ClassDef, *FUNCTIONS)
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)


@dataclass(frozen=True)
class Source:
    """A file: its nodes without docstrings and annotations, and the numbers of its lines of code."""

    text: str
    nodes: list
    lines: set


def source_of(path):
    text = path.read_text()
    tree = ast.parse(text)
    docstrings = set()
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node) is not None:
            first = node.body.pop(0)
            docstrings.update(range(first.lineno, first.end_lineno + 1))
        if isinstance(node, FUNCTIONS):
            node.returns = None
            for argument in [
                *node.args.posonlyargs,
                *node.args.args,
                *node.args.kwonlyargs,
            ]:
                argument.annotation = None
    lines = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    nodes = [node for node in ast.walk(tree) if not isinstance(node, UNCOUNTED)]
    return Source(text, nodes, lines - docstrings)


def count_nodes(path):
    """Nodes of a file's syntax tree: what a reader has to take in."""
    return len(source_of(path).nodes)


def is_parallel(node):
    """Whether a statement is ``a, b = x, y``, which could be two."""
    return (
        isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Tuple)
        and isinstance(node.value, ast.Tuple)
    )


def density(paths):
    """Nodes, nodes a line (median, and of the densest tenth), and how many of 1000 lines hold what."""
    a_line = []
    found = Counter()
    for path in paths:
        source = source_of(path)
        at = Counter(node.lineno for node in source.nodes if hasattr(node, "lineno"))
        rows = source.text.splitlines()
        a_line += [at[number] for number in source.lines if at[number]]
        found["nodes"] += len(source.nodes)
        found["lines"] += len(source.lines)
        found["parallel"] += sum(map(is_parallel, source.nodes))
        found["ternary"] += sum(isinstance(node, ast.IfExp) for node in source.nodes)
        found["comprehensions"] += sum(isinstance(n, COMPREHENSIONS) for n in source.nodes)
        found["long"] += sum(len(rows[number - 1]) > 100 for number in source.lines)
        found["skips"] += source.text.count("fmt: skip")
    a_line.sort()
    rate = {
        name: 1000 * count / found["lines"]
        for name, count in found.items()
        if name not in ("nodes", "lines")
    }
    return rate | {
        "nodes": found["nodes"],
        "median": statistics.median(a_line),
        "densest tenth": a_line[int(0.9 * len(a_line))],
    }
