import sys
from pathlib import Path
from types import SimpleNamespace

import matplotlib.pyplot as plt
import nbformat
import pytest
from nbclient import NotebookClient

from tests.support import SOURCES, make_runs_tiny

NOTEBOOK = Path(__file__).parent.parent.parent / "experiments" / "explore_train_step.ipynb"

TINY = f"""
import sys
sys.path[:0] = {SOURCES.split(":")}
from tests.support import make_runs_tiny
make_runs_tiny()
"""


@pytest.mark.slow
def test_its_cells_train_and_draw(monkeypatch, capsys):
    make_runs_tiny(monkeypatch)
    updates, names = [], {}
    monkeypatch.setattr("IPython.display.display", lambda *_, **__: SimpleNamespace(update=updates.append))
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    for cell in nbformat.read(NOTEBOOK, as_version=4).cells:
        if cell.cell_type == "code":
            exec(cell.source, names)
    assert len(names["history"]) == len(updates) == 7
    assert capsys.readouterr().out.count("reached at step") == 3
    assert len(names["curves"].axes[0].lines[0].get_xdata()) == 7
    assert len(names["axes"][0].lines) == 2 * 6
    plt.close("all")


@pytest.mark.slow
def test_the_notebook_runs_from_top_to_bottom():
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(TINY))
    updates = []
    client = NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(NOTEBOOK.parent)}})
    process = client.process_message

    def watch(message, cell, cell_index):
        if message["header"]["msg_type"] == "update_display_data":
            updates.append(message["content"]["data"]["image/png"])
        return process(message, cell, cell_index)

    client.process_message = watch
    client.execute()
    pictures = [
        output for cell in notebook.cells for output in cell.get("outputs", []) if "image/png" in output.get("data", {})
    ]
    assert len(pictures) == 2  # the curves, which are one figure however often it is drawn, and the trajectories
    assert len(set(updates)) == 7  # after each round, and each time another


@pytest.mark.parametrize("on_colab", [True, False])
def test_the_package_is_installed_on_colab_alone(monkeypatch, on_colab):
    first = next(cell for cell in nbformat.read(NOTEBOOK, as_version=4).cells if cell.cell_type == "code")
    started = []
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    monkeypatch.setattr("subprocess.run", lambda command, check: started.append(command))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    if on_colab:
        monkeypatch.setitem(sys.modules, "google.colab", sys)
    exec(first.source, {})
    assert [command[1:4] for command in started] == [["-m", "pip", "install"]] * on_colab
