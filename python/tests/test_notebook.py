"""The notebooks of examples/python run from beginning to end."""

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")


def test_notebooks_run(root):
    notebooks = sorted((root / "examples/python").glob("*.ipynb"))
    assert notebooks
    for path in notebooks:
        notebook = nbformat.read(path, as_version=4)
        assert not any(cell.get("outputs") for cell in notebook.cells), f"{path.name} is stored without outputs"
        client = nbclient.NotebookClient(
            notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}
        )
        client.execute()
        shown = "".join(str(cell.get("outputs", "")) for cell in notebook.cells)
        assert "<svg" in shown and "<script" not in shown
