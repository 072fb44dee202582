"""How a recipe starts and ends: its configuration is checked, its folder is locked, its errors end in one line."""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import hydra
import joblib
import omegaconf
import torch
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, read_write
from omegaconf.errors import OmegaConfBaseException

import torchrl_quad
from torchrl_quad.dynamics import presets
from torchrl_quad.envs import available_tasks, task_class
from torchrl_quad.errors import UserError, UserValueError
from torchrl_quad.training.arguments import hydra_argument
from torchrl_quad.training.checkpoints import take_over
from torchrl_quad.training.folders import own_folder
from torchrl_quad.training.own import CONFIG, OWN, offer_tasks, own_recipe
from torchrl_quad.training.processes import from_the_first, joined, rank
from torchrl_quad.training.schema import check

MAX_DEPTH = 20  # of lists and mappings within each other, as in a YAML file
FOLDER_SETTINGS = ("hydra.run.dir", "hydra.sweep.dir", "hydra.sweep.subdir")
NO_MEMORY = "the memory is full. Lower num_envs, horizon, batch_size, or the size of the networks."
THEIRS = tuple(str(Path(module.__file__).parent) for module in (hydra, omegaconf, joblib))


class Refused(BaseException):
    """An error that its message explains: no traceback is needed. Hydra lets it pass, since it is no Exception."""


class RefusedInSweep(Exception):
    """The same in one run of a sweep: hydra reports it when the others have ended."""


class Stopped(KeyboardInterrupt):
    """Ctrl-C, with a message that says how to go on."""


class CheckBeforeFolder(Callback):
    """Checks the configuration of a single run before hydra makes its folder; common.yaml names it."""

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Refuse what the schema refuses."""
        with _explained():
            _check(config, config.hydra)


def recipe(config: str, **settings: Any) -> Callable[[Callable[[DictConfig], None]], Callable[[], None]]:
    """Make a program of ``main(cfg)``, with the configuration ``config/NAME.yaml`` and hydra's command line.

    A recipe of your own, anywhere, takes the configuration that suits it best and says what differs:
    ``@recipe("bptt", algorithm="smooth", loss={"smoothness": 0.1})``. ``algorithm`` names its runs.

    Errors that have an explanation end in one line and exit status 2, Ctrl-C in one line and 130; with
    ``HYDRA_FULL_ERROR=1`` in a traceback. While a training recipe runs, it alone writes into its folder,
    ``HydraConfig.get().runtime.output_dir``.
    """

    name = own_recipe(config, settings) if settings else config
    registered: dict[str, type] = {}  # travels along with the job into the processes of a sweep
    flies = []  # once main has been called

    def decorate(main: Callable[[DictConfig], None]) -> Callable[[], None]:
        @hydra.main(config_path=str(CONFIG), config_name=name, version_base=None)
        @functools.wraps(main)
        def job(cfg: DictConfig) -> None:
            torchrl_quad.envs.TASKS.update(registered)  # of this process, whatever has been copied into it
            if settings:
                OWN[name] = config, settings
            try:
                with _explained():
                    _check(cfg, HydraConfig.get())
                    if "algorithm" not in cfg:
                        flies.append(name)
                        main(cfg)
                        return
                    with joined(cfg), _run_folder(cfg.resume) as folder, _resumable(folder, cfg.task):
                        take_over(cfg, folder)
                        flies.append(name)
                        main(cfg)
            except Refused as error:
                if HydraConfig.get().mode == RunMode.MULTIRUN:
                    raise RefusedInSweep(str(error)) from error
                raise

        @functools.wraps(main)
        def program() -> None:
            full = os.environ.get("HYDRA_FULL_ERROR", "0") not in ("", "0")
            os.environ["HYDRA_FULL_ERROR"] = "1"  # hydra then leaves all exceptions to us
            sys.argv[1:] = map(hydra_argument, sys.argv[1:])
            if os.getcwd() not in sys.path:
                sys.path.append(os.getcwd())  # where tasks of your own may be
            registered.update(torchrl_quad.envs.TASKS)
            try:
                with _explained():
                    for path in sorted(CONFIG.rglob("*.yaml")):
                        presets.parse(path.read_bytes(), str(path))
                    sys.argv[1:] = offer_tasks(sys.argv[1:])
                    for argument in sys.argv[1:]:
                        _require_flat(argument)
                job()
            except (Refused, RefusedInSweep) as error:
                _end(error, 2, full)
            except KeyboardInterrupt as error:
                _end(error if str(error) else Stopped("Stopped. What is finished is kept."), 130, full)
            except Exception as error:
                if flies or not _is_of_the_command_line(error):
                    raise
                _end(error, 2, full)
            finally:
                os.environ["HYDRA_FULL_ERROR"] = str(int(full))

        return program

    return decorate


def _end(error: BaseException, status: int, full: bool) -> None:
    """Say in one line what went wrong, and exit."""
    if full:
        raise error
    said = str(error).splitlines() or [repr(error)]
    if isinstance(error, HydraException) and isinstance(error.__cause__, OmegaConfBaseException):
        said += str(error.__cause__).splitlines()[:1]
    if isinstance(error, OSError) and error.filename:
        said = [f"{error.filename}: {error.strerror}. Choose another hydra.run.dir."]
    if isinstance(error, MissingConfigException) and str(error.missing_cfg_file).startswith("task/"):
        try:
            task_class(error.missing_cfg_file.removeprefix("task/"))
        except ValueError as unknown:
            said = [str(unknown)]
    message = " ".join(line.strip() for line in said if line.strip())
    print(message if status == 130 else f"Error: {message}", file=sys.stderr)
    raise SystemExit(status) from None


def _check(cfg: DictConfig, hydra_config: DictConfig) -> None:
    """Check a configuration, and that the command line takes effect."""
    name, overrides = hydra_config.job.config_name, hydra_config.overrides
    if cfg.get("algorithm", name) != name:
        raise UserValueError(
            f"algorithm={cfg.algorithm}: this recipe is {name}, whatever it is called. Run the recipe of that name."
        )
    check(cfg, overrides.task)
    if cfg.get("resume") not in (None, "auto") and hydra_config.mode != RunMode.MULTIRUN:
        asked = Path(hydra_config.run.dir)
        if asked.resolve() != Path(cfg.resume).resolve().parent:
            raise UserValueError(
                f"hydra.run.dir={asked} has no effect: resume={cfg.resume} goes on in the folder of that checkpoint. "
                "Leave it out."
            )


def _require_flat(argument: str) -> None:
    depth = 0
    for letter in argument:
        depth += (letter in "[{(") - (letter in ")}]")
        if depth > MAX_DEPTH:
            raise UserValueError(
                f"{argument[:40]}... nests more than {MAX_DEPTH} lists or mappings. Give the path of a YAML file."
            )


def _is_of_the_command_line(error: Exception) -> bool:
    """Whether hydra, or the system, refuses what the user has written: with no mistake of ours in between."""
    if isinstance(error, (HydraException, OmegaConfBaseException, OSError, yaml.YAMLError)):
        return True
    return traceback.extract_tb(error.__traceback__)[-1].filename.startswith(THEIRS)


@contextlib.contextmanager
def _explained() -> Iterator[None]:
    """Turn errors that their message explains into refusals; all others keep their traceback."""
    try:
        yield
    except (UserError, OSError) as error:
        raise Refused(str(error)) from error
    except (MemoryError, torch.OutOfMemoryError) as error:
        raise Refused(NO_MEMORY) from error
    except RuntimeError as error:
        if "can't allocate memory" not in str(error):
            raise
        raise Refused(NO_MEMORY) from error


@contextlib.contextmanager
def _run_folder(resume: str | None) -> Iterator[Path]:
    """Hold the folder of this run, the same for all processes that train together.

    That is the checkpoint's if one is named, otherwise the one that hydra has made; or one beside it, if another run
    has got hydra's and the user has not named it.
    """
    hydra_config = HydraConfig.instance().cfg.hydra
    made = Path(hydra_config.runtime.output_dir)
    goes_on = resume not in (None, "auto")
    named = goes_on or any(x.lstrip("+").startswith(FOLDER_SETTINGS) for x in hydra_config.overrides.hydra)
    with contextlib.ExitStack() as stack:
        folder = Path(resume).resolve().parent if goes_on else made
        folder = stack.enter_context(own_folder(folder, named)) if rank() == 0 else None
        folder = from_the_first(folder)
        if folder != made:
            with contextlib.suppress(OSError):  # not empty
                made.rmdir()
        with read_write(hydra_config):
            hydra_config.runtime.output_dir = str(folder)
        yield folder


@contextlib.contextmanager
def _resumable(folder: Path, task: str) -> Iterator[None]:
    """Say how to go on when the run is stopped, or when the disk is full."""
    checkpoint = folder / "checkpoint.pt"
    named = "" if task in available_tasks() else f" task={task}"
    how = f"Go on with: python {sys.argv[0]} resume={checkpoint}{named}"
    try:
        yield
    except KeyboardInterrupt as error:
        saved = how if checkpoint.exists() else "Nothing was saved yet: the first evaluation writes a checkpoint."
        raise Stopped(f"Stopped. {saved}") from error
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        saved = f"The last checkpoint is intact. Make room. {how}" if checkpoint.exists() else "Nothing was saved yet."
        raise Refused(f"the disk is full: {error.filename or folder}. {saved}") from error
