"""Adapt the best policy of a training run to logs of its flights: a new checkpoint, a folder that flies, and a report.

python recipes/adapt.py checkpoint=outputs/.../checkpoint.pt 'logs=[flight1.csv]'
"""

from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf

from torchrl_quad.adaptation import Adapter, write_report
from torchrl_quad.deploy import export_policy, frames
from torchrl_quad.dynamics import MotorCommand
from torchrl_quad.files import make_folder
from torchrl_quad.identification import read_log
from torchrl_quad.training.building import build_env
from torchrl_quad.training.checkpoints import read_checkpoint, write_checkpoint
from torchrl_quad.training.evaluation import load_policy
from torchrl_quad.training.launch import recipe


@recipe("adapt")
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    checkpoint = Path(cfg.checkpoint)
    trained, actor, normalizer = load_policy(checkpoint, trust=cfg.trust)
    convention = None if cfg.convention is None else getattr(frames, cfg.convention)()
    columns = OmegaConf.to_container(cfg)["columns"]
    logs = [read_log(path, columns, convention=convention) for path in cfg.logs]
    motors = None if cfg.motor_command is None else MotorCommand(**cfg.motor_command)
    env = build_env(trained, cfg.num_envs, cfg.seed, compile=cfg.compile, normalizer=normalizer)
    adapter = Adapter(actor, env, motors, **{name: cfg[name] for name in ("max_kl", "steps", "num_envs", "seed")})
    print(f"Compiled in {adapter.warm_up():.0f} s.")
    found = adapter(logs)
    print(found.reason)
    folder = make_folder(cfg.folder or checkpoint.parent / "adapted")
    write_report(found, folder / "report.html", logs)
    if found.changed:
        saved = read_checkpoint(checkpoint)
        saved["best"] |= {"actor": found.policy.state_dict()}
        write_checkpoint(folder / "checkpoint.pt", saved)
        export_policy(found.policy, env, folder / "policy", origin={"adapted_from": ", ".join(x.name for x in logs)})
    print(f"{folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")


if __name__ == "__main__":
    main()
