"""How a recipe starts and ends: its configuration is checked, its folder is locked, its errors end in one line."""

from __future__ import annotations

import contextlib
import errno
import functools
import itertools
import os
import re
import socket
import sys
import traceback
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import hydra
import joblib
import omegaconf
import torch
import torch.distributed as dist
import yaml
from filelock import Timeout
from hydra.core.hydra_config import HydraConfig
from hydra.errors import ConfigCompositionException, HydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, read_write
from omegaconf.errors import OmegaConfBaseException

import torchrl_quad
from torchrl_quad.errors import UserError, UserValueError
from torchrl_quad.files import locked, make_folder
from torchrl_quad.training.building import of_first, rank
from torchrl_quad.training.checkpoints import take_over
from torchrl_quad.training.configuration import CONFIG, OWN, command_line, named_code, own_recipe, plain
from torchrl_quad.training.schema import check

LOCK = "run.lock"  # names the process that writes into the folder of a run

# A run that resumes continues in the folder of its checkpoint; hydra.run.dir asks for it by this name.
OmegaConf.register_new_resolver(
    "folder_of", lambda resume, new: new if resume in (None, "auto") else str(Path(resume).parent), replace=True
)


class Refused(BaseException):
    """An error that its message explains: no traceback is needed. Hydra lets it pass, since it is no Exception."""


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
    ``HYDRA_FULL_ERROR=1`` in a traceback. While a training recipe runs, no other process writes into its folder,
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
                with _explained(), contextlib.ExitStack() as stack:
                    if HydraConfig.get().mode == RunMode.MULTIRUN or "check" not in HydraConfig.get().callbacks:
                        _check(cfg, HydraConfig.get())  # others have been checked before their folder was made
                    if "algorithm" in cfg:
                        stack.enter_context(_joined(cfg))
                        folder = stack.enter_context(_run_folder(cfg.resume))
                        stack.enter_context(_resumable(folder, cfg))
                        take_over(cfg, folder)
                    flies.append(name)
                    torch.set_num_threads(cfg.threads)
                    main(cfg)
            except Refused as error:
                if HydraConfig.get().mode == RunMode.MULTIRUN:  # hydra reports it when the other runs have ended
                    raise UserError(str(error)) from error
                raise

        @functools.wraps(main)
        def program() -> None:
            full = os.environ.get("HYDRA_FULL_ERROR", "0") not in ("", "0")
            os.environ["HYDRA_FULL_ERROR"] = "1"  # hydra then leaves all exceptions to us
            if os.getcwd() not in sys.path:
                sys.path.append(os.getcwd())  # where tasks of your own may be
            registered.update(torchrl_quad.envs.TASKS)
            try:
                with _explained():
                    sys.argv[1:] = command_line(sys.argv[1:])
                _run(job)
            except (Refused, UserError) as error:
                _end(error, 2, full)
            except KeyboardInterrupt as error:
                _end(error if str(error) else KeyboardInterrupt("Stopped. What is finished is kept."), 130, full)
            except Exception as error:
                if flies or not _is_of_the_command_line(error):
                    raise
                _end(error, 2, full)
            finally:
                os.environ["HYDRA_FULL_ERROR"] = str(int(full))

        return program

    return decorate


def _run(job: Callable[[], None]) -> None:
    """Run hydra's job. A setting that the files lack is added: the schema takes it, as env.weights.position, or says
    why it does not."""
    while True:
        try:
            return job()
        except ConfigCompositionException as error:
            lacking = re.match(r"Could not override '(?!hydra\.)(.+?)'\.", str(error))
            known = [f"+{x}" if lacking and x.startswith(f"{lacking[1]}=") else x for x in sys.argv[1:]]
            if known == sys.argv[1:]:
                raise
            sys.argv[1:] = known


def _end(error: BaseException, status: int, full: bool) -> None:
    """Say in one line what went wrong, and exit."""
    if full:
        raise error
    said = str(error).splitlines() or [repr(error)]
    if isinstance(error, HydraException) and isinstance(error.__cause__, OmegaConfBaseException):
        said += str(error.__cause__).splitlines()[:1]
    if isinstance(error, OSError) and error.filename:
        said = [f"{error.filename}: {error.strerror}. Choose another hydra.run.dir."]
    message = " ".join(line.strip() for line in said if line.strip())
    print(message if status == 130 else f"Error: {message}", file=sys.stderr)
    raise SystemExit(status) from None


def _check(cfg: DictConfig, hydra_config: Any) -> None:
    """Check a configuration, and that the command line takes effect."""
    name, overrides = hydra_config.job.config_name, hydra_config.overrides
    if cfg.get("algorithm", name) != name:
        raise UserValueError(f"algorithm={cfg.algorithm}: this recipe is {name}. Run the recipe of that name.")
    check(cfg, overrides.task)
    if cfg.get("resume") not in (None, "auto") and hydra_config.mode != RunMode.MULTIRUN:
        asked = Path(hydra_config.run.dir)
        if asked.resolve() != Path(cfg.resume).resolve().parent:
            raise UserValueError(
                f"hydra.run.dir={asked} has no effect: resume={cfg.resume} continues in the folder of that checkpoint. "
                "Leave it out."
            )


def _is_of_the_command_line(error: Exception) -> bool:
    """Whether hydra, or the system, refuses what the user has written: with no mistake of ours in between."""
    if isinstance(error, (HydraException, OmegaConfBaseException, OSError, yaml.YAMLError)):
        return True
    theirs = tuple(str(Path(str(module.__file__)).parent) for module in (hydra, omegaconf, joblib))
    return traceback.extract_tb(error.__traceback__)[-1].filename.startswith(theirs)


@contextlib.contextmanager
def _explained() -> Iterator[None]:
    """Turn errors that their message explains into refusals; all others keep their traceback."""
    try:
        yield
    except (UserError, OSError) as error:
        raise Refused(str(error)) from error
    except (MemoryError, RuntimeError) as error:
        lines = re.findall(r'File "(.+)", line (\d+), in', str(error))
        if isinstance(error, torch._dynamo.exc.Unsupported) and lines:
            where, why = ":".join(lines[-1]), str(error).partition("\n")[0]
            told = (
                "Do not branch on data: use torch.where, and no .item()" if "ata-dependent" in why else "Leave it out"
            )
            told += ", or write compile=false"
            raise Refused(f"{where}: the compiler cannot follow this line: {why}. {told}.") from error
        if isinstance(error, MemoryError | torch.OutOfMemoryError) or "can't allocate memory" in str(error):
            why = "the memory is full. Lower num_envs, horizon, batch_size, or the size of the networks."
            raise Refused(why) from error
        raise


@contextlib.contextmanager
def _joined(cfg: DictConfig) -> Iterator[None]:
    """Join the processes that torchrun has started, if it has, and leave them at the end."""
    if "RANK" in os.environ:
        if ":" in cfg.device:
            raise UserValueError(
                f"device={cfg.device}: under torchrun each process takes its own GPU. Write device=cuda."
            )
        if cfg.device == "cuda":
            torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
        dist.init_process_group("nccl" if cfg.device == "cuda" else "gloo")
    yield
    if dist.is_initialized():  # after an error the others may wait for this one: torchrun ends them
        dist.destroy_process_group()


@contextlib.contextmanager
def _run_folder(resume: str | None) -> Iterator[Path]:
    """Hold the folder of this run, the checkpoint's if one is named, the same for all processes that train together."""
    hydra_config: Any = HydraConfig.get()
    made = Path(hydra_config.runtime.output_dir)
    goes_on = resume not in (None, "auto")
    folders = ("hydra.run.dir", "hydra.sweep.")
    named = goes_on or any(x.lstrip("+").startswith(folders) for x in hydra_config.overrides.hydra)
    folder = Path(str(resume)).resolve().parent if goes_on else made
    with own_folder(folder, named) if rank() == 0 else contextlib.nullcontext(folder) as own:
        first = of_first(own)
        if first != made:
            with contextlib.suppress(OSError):  # not empty
                made.rmdir()
        with read_write(hydra_config):
            hydra_config.runtime.output_dir = str(first)
        yield first


@contextlib.contextmanager
def own_folder(folder: Path, named: bool) -> Iterator[Path]:
    """Hold a folder that no other process writes into, and give it back at the end.

    A folder that the user has named is taken as it is. Otherwise its name is only a proposal: when another run has it,
    the next free one of ``folder_2``, ``folder_3`` and so on is made.
    """
    for number in itertools.count(1):
        path = make_folder(folder if number == 1 else folder.with_name(f"{folder.name}_{number}"))
        with contextlib.ExitStack() as stack:
            try:
                lock = stack.enter_context(locked(path / LOCK, wait=False))
            except Timeout:
                if not named:
                    continue
                holder = "another process"
                with contextlib.suppress(OSError):  # it has ended just now
                    holder = (path / LOCK).read_text().strip() or holder
                raise FileExistsError(
                    f"{path} is in use by {holder}. Wait for it, stop it, or choose another hydra.run.dir."
                ) from None
            if not named and any(other.name != LOCK for other in path.iterdir()):  # a run that is over
                continue
            now = datetime.now()
            lock.write_text(f"process {os.getpid()} on {socket.gethostname()} since {now:%Y-%m-%d %H:%M:%S}\n")
            try:
                yield path
            finally:
                stack.close()
                if not named:
                    with contextlib.suppress(OSError):  # not empty: it has results
                        for empty in itertools.takewhile(Path.cwd().__ne__, (path, *path.parents)):
                            empty.rmdir()
            return


@contextlib.contextmanager
def _resumable(folder: Path, cfg: DictConfig) -> Iterator[None]:
    """Say how to continue when the run is stopped, or when the disk is full."""
    checkpoint = folder / "checkpoint.pt"
    try:
        yield
    except (KeyboardInterrupt, OSError) as error:
        trust = ", ".join(named_code(plain(cfg)))
        how = f"Continue with: python {sys.argv[0]} resume={checkpoint}" + (f" 'trust=[{trust}]'" if trust else "")
        is_saved = checkpoint.exists()
        if isinstance(error, KeyboardInterrupt):
            why = how if is_saved else "Nothing was saved yet: the first evaluation writes a checkpoint."
            raise KeyboardInterrupt(f"Stopped. {why}") from error
        if error.errno != errno.ENOSPC:
            raise
        why = f"The last checkpoint is intact. Make room. {how}" if is_saved else "Nothing was saved yet."
        raise Refused(f"the disk is full: {error.filename or folder}. {why}") from error
