"""The notebooks and programs of examples/python run from beginning to end."""

import runpy

import pytest

from conftest import ROOT

NOTEBOOKS = sorted((ROOT / "examples/python").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path):
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    notebook = nbformat.read(path, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), f"{path.name} is stored without outputs"
    source = "".join(cell["source"] for cell in notebook.cells)
    if "from distributed import" in source:
        pytest.importorskip("distributed")
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}
    )
    client.execute()
    shown = "".join(str(cell.get("outputs", "")) for cell in notebook.cells)
    assert "<svg" in shown and "<script" not in shown


def test_a_joint_of_mujoco_loses_the_work_of_friction(root):
    pytest.importorskip("mujoco")
    example = runpy.run_path(str(root / "examples/python/mujoco_joint.py"))
    drifts = []
    for step in (4e-4, 2e-4):
        found = example["swing"](step, duration=3.0)
        drifts.append(abs(found["lost"] / found["work"] - 1))
        assert found["lost"] > 1.0
    assert drifts[0] < 1e-3 and 1.6 < drifts[0] / drifts[1] < 2.5, "the drift is of first order in the step"
