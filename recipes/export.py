"""Export the best policy of a training run: a folder that flies without torch.

python recipes/export.py checkpoint=outputs/.../checkpoint.pt
python recipes/export.py checkpoint=outputs/.../checkpoint.pt target=crazyflie   # with code for its firmware
"""

from pathlib import Path

from omegaconf import DictConfig

from torchrl_quad.deploy import export_policy, load_bundle
from torchrl_quad.deploy.contract import sha256
from torchrl_quad.deploy.export import STARTS
from torchrl_quad.deploy.targets import write_target
from torchrl_quad.training.building import build_env
from torchrl_quad.training.checkpoints import read_checkpoint
from torchrl_quad.training.evaluation import load_policy
from torchrl_quad.training.launch import recipe


@recipe("export")
def main(cfg: DictConfig) -> None:
    checkpoint = Path(cfg.checkpoint)
    trained, actor, normalizer = load_policy(checkpoint, trust=cfg.trust)
    env = build_env(trained, cfg.episodes, STARTS, normalizer=normalizer)
    origin = {"revision": read_checkpoint(checkpoint)["revision"], "checkpoint_sha256": sha256(checkpoint.read_bytes())}
    folder = export_policy(actor, env, cfg.folder or checkpoint.parent / "policy", origin=origin)
    bundle = load_bundle(folder)
    if cfg.target is not None:
        print(f"{write_target(folder, cfg.target)}: for the firmware of {cfg.target}")
    print(f"{folder}: flies {bundle.contract['task']['name']}; its actions differ by at most {bundle.check():.1e}")


if __name__ == "__main__":
    main()
