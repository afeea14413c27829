"""How JupyterLab saves under ``make lab``: the notebook that records keeps its stored outputs."""

from pathlib import Path

import nbformat
from jupyter_server.services.contents.largefilemanager import AsyncLargeFileManager

# its outputs are somebody's recording, which has its own folder
RECORDING = "09_acquire_session.ipynb"


class Contents(AsyncLargeFileManager):
    """Saves notebooks as always, but for `RECORDING`: running it leaves its file as it was."""

    async def save(self, model, path=""):
        """Save a model (a dict of JupyterLab) to a path below its folder."""
        file = Path(self.root_dir, path.strip("/"))
        if model["type"] == "notebook" and file.name == RECORDING and file.is_file():
            stored = nbformat.read(file, as_version=4)
            model = model | {"content": with_stored_outputs(model["content"], stored)}
        return await super().save(model, path)


def with_stored_outputs(notebook, stored):
    """A notebook whose unchanged cells are the stored ones; cells that were changed have no
    outputs.

    Both are notebooks as JSON has them, and so is what comes back.
    """
    known = {(cell["id"], "".join(cell["source"])): cell for cell in stored["cells"]}
    cells = []
    for cell in notebook["cells"]:
        changed = cell
        if cell["cell_type"] == "code":
            changed = cell | {"outputs": [], "execution_count": None}
        unchanged = (cell.get("id"), "".join(cell["source"]))
        cells.append(known.get(unchanged, changed))
    return dict(stored) | {"cells": cells}
