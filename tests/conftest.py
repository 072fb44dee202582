import gc
import importlib.util
import os
import runpy
import sys
import threading
from pathlib import Path

import pytest
import torch
import yaml

pytest.register_assert_rewrite("browsing", "deploying", "helpers", "log_writers")

from browsing import browser, open_page  # noqa: E402, F401, fixtures
from deploying import export_once, trace_once  # noqa: E402, F401, fixtures

from torchrl_quad import HoveringEnv  # noqa: E402
from torchrl_quad.envs.markers import Markers, Shape  # noqa: E402

os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the programs that tests start, which go side by side
RECIPES = Path(__file__).parent.parent / "recipes"
if importlib.util.find_spec("pandas") is None:
    sys.modules["pandas"] = None  # which tensordict looks for in each call of a module, on the disk

LONG = {"test_docs.py", "test_transforms.py", "test_horizon.py", "test_processes.py", "test_replay.py"}


def pytest_collection_modifyitems(items):
    """The longest tests start first, so that no worker is left alone with one at the end."""
    items.sort(key=lambda item: item.path.name not in LONG)


def pytest_collection_finish():
    """What has been imported, most of a million objects, need not be looked through again: a tenth of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 10, 10)


@pytest.fixture(autouse=True)
def one_thread_and_a_fixed_seed():
    torch.set_num_threads(1)
    torch.manual_seed(0)


@pytest.fixture
def quick_fits(monkeypatch):
    """Drones are identified in longer steps: quicker, and hardly worse."""
    monkeypatch.setattr("torchrl_quad.identification.estimation._BODY_STEP", 0.05)


@pytest.fixture
def env():
    return HoveringEnv(num_envs=4, seed=1)


@pytest.fixture
def env64():
    return HoveringEnv(num_envs=4, seed=1, dtype=torch.float64)


@pytest.fixture
def crashing():
    """Flies an environment of hovering for some steps, in which drone 1 soon hits the ceiling."""

    def fly(env, steps):
        td = env.reset()
        td["state", "position"][1] = torch.tensor([1.0, 0.0, 5.95])
        td["state", "velocity"][1, 2] = 5.0
        start = env.reset(td, set_state=True)
        return env.rollout(steps, tensordict=start, auto_reset=False, break_when_any_done=False)

    return fly


@pytest.fixture
def own_markers():
    """A task of one's own, whose markers names everything that there is."""

    class Window(HoveringEnv):
        """To a point behind a window."""

        def markers(self):
            wall = Shape.box((0.2, -1.0, 0.0), (0.3, -0.4, 2.5), name="wall")
            ball = Shape.sphere((1.5, 0.8, 1.0), 0.2, name="ball", color="#c8452f")
            tree = Shape.cylinder((0.8, -0.8, 0.0), 0.1, 1.8, name="tree", color="#3a9a5b")
            rope = Shape.line([(0, 0, 1), (1, 0, 2), (2, 1, 1)], name="rope")
            targets = {"places": [(2.0, 0.0, 1.5)], "curve": [(0, 0, 1.5), (1, 0, 1.5)]}
            return Markers(gates=[(0.25, 0.0, 1.5)], gate_radius=0.4, shapes=[wall, ball, tree, rope], **targets)

    return Window


@pytest.fixture
def launch(monkeypatch, capsys):
    """``python recipes/NAME.py ARGUMENTS``, but in this process, where it starts quicker and parts can be replaced."""
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    monkeypatch.setenv("WANDB_MODE", "offline")
    # Hydra composes a configuration once more to find its mode, which none of ours sets, reads YAML in Python, and
    # copies its whole store for each run, and then each entry that it reads.
    monkeypatch.setattr("hydra._internal.hydra.Hydra.get_mode", lambda *args, **kwargs: None)
    monkeypatch.setattr("yaml.SafeLoader", yaml.CSafeLoader)
    monkeypatch.setattr("hydra.core.config_store.ConfigStore.__deepcopy__", lambda store, _: store, raising=False)

    def launch(name, *arguments):
        monkeypatch.setattr(sys, "argv", [f"recipes/{name}.py", *map(str, arguments)])
        runpy.run_path(str(RECIPES / f"{name}.py"), run_name="__main__")
        return capsys.readouterr().out

    return launch


@pytest.fixture
def refused(launch, capsys):
    """The line in which a recipe ends that is refused, or stopped."""

    def refused(name, *arguments, status=2):
        with pytest.raises(SystemExit) as exit:
            launch(name, *arguments)
        said = capsys.readouterr().err.splitlines()
        assert exit.value.code == status, said
        assert not any("Traceback" in line for line in said)
        return said[-1]

    return refused


@pytest.fixture
def no_pictures(monkeypatch):
    """Runs in this process draw nothing, which is most of what a small one does."""
    from torchrl_quad.training import drawing

    monkeypatch.setattr(drawing, "draw_flight", lambda *args: None)
    monkeypatch.setattr(drawing, "publish_flight", lambda *args: None)
    monkeypatch.setattr(drawing, "draw_learning_curve", lambda metrics, path, env: path.touch())


@pytest.fixture
def train(launch, no_pictures):
    """A small run without pictures; its checkpoint."""
    from helpers import SMALL

    from torchrl_quad.training.checkpoints import read_checkpoint

    def train(recipe, folder, *overrides):
        launch(recipe, *SMALL, f"hydra.run.dir={folder}", *overrides)
        return read_checkpoint(folder / "checkpoint.pt")

    return train


@pytest.fixture
def run_here(launch, no_pictures):
    """As ``benchmarks.paper.running.run``, but in this process, one after the other, and without pictures."""
    alone = threading.Lock()

    def run(recipe, overrides, folder):
        with alone:
            launch(recipe, *overrides, "resume=auto", f"hydra.run.dir={folder}")

    return run
