"""Adapt the best policy of a training run to logs of its flights: a new checkpoint, a folder that flies, and a report.

python recipes/adapt.py checkpoint=outputs/.../checkpoint.pt 'logs=[flight1.csv]'
"""

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from torchrl_quad.adaptation import Adapter, write_report
from torchrl_quad.deploy import export_policy, frames
from torchrl_quad.deploy.contract import sha256
from torchrl_quad.dynamics import MotorCommand
from torchrl_quad.files import replacing_folder
from torchrl_quad.identification import read_log
from torchrl_quad.training.building import build_env
from torchrl_quad.training.checkpoints import read_checkpoint, write_checkpoint
from torchrl_quad.training.evaluation import load_policy
from torchrl_quad.training.launch import recipe


@recipe("adapt")
def main(cfg: DictConfig) -> None:
    checkpoint = Path(cfg.checkpoint)
    trained, actor, normalizer = load_policy(checkpoint, trust=cfg.trust)
    settings = OmegaConf.to_container(cfg)
    convention = settings["convention"] and frames.named(settings["convention"])
    reading = {"convention": convention, **(settings["reading"] or {})}
    logs = [read_log(path, settings["columns"], **reading) for path in cfg.logs]
    motors = None if cfg.motor_command is None else MotorCommand(**cfg.motor_command)
    place = Path(cfg.folder or checkpoint.parent / "adapted")
    with replacing_folder(place, report_only) as folder:
        env = build_env(trained, cfg.num_envs, cfg.seed, compile=cfg.compile, normalizer=normalizer)
        adapter = Adapter(actor, env, motors, **{name: cfg[name] for name in ("max_kl", "steps", "num_envs", "seed")})
        print(f"Compiled in {adapter.warm_up():.0f} s.")
        found = adapter(logs)
        print("\n".join([*(f"{log.name}: {note}" for log in logs for note in log.notes), found.reason]))
        write_report(found, folder / "report.html", logs)
        if found.fit is not None and found.changed:
            saved = read_checkpoint(checkpoint)
            saved["best"] |= {"actor": found.policy.state_dict(), "return": found.after["return"]}
            write_checkpoint(folder / "checkpoint.pt", saved | {"stateful": [], "processes": []})  # no run to continue
            adapter.task.set_params(found.fit.drone())
            origin = {
                "adapted_from": ", ".join(x.name for x in logs),
                "checkpoint_sha256": sha256(checkpoint.read_bytes()),
            }
            export_policy(found.policy, adapter.env, folder / "policy", origin=origin | {"revision": saved["revision"]})
        written = ", ".join(sorted(path.name for path in folder.iterdir()))
    print(f"{place}: {written}")


def report_only(folder: Path) -> None:
    """Raise FileExistsError for a folder that holds more than a report: nothing else is replaced."""
    if found := sorted(x.name for x in folder.iterdir() if x.name != "report.html") if folder.is_dir() else []:
        raise FileExistsError(f"{folder} holds {', '.join(found[:5])} already. Choose another folder=.")


if __name__ == "__main__":
    main()
