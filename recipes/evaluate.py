"""Fly the best policy of a training run: deterministic, over fresh episodes.

python recipes/evaluate.py checkpoint=outputs/.../checkpoint.pt
"""

from pathlib import Path

import hydra
import torch
from checkpoints import write_json
from common import final_evaluation, load_policy
from omegaconf import DictConfig
from run import print_summary

from torchrl_quad.render import plot_flight


@hydra.main(config_path="config", config_name="evaluate", version_base=None)
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    trained, actor, normalizer = load_policy(Path(cfg.checkpoint), cfg.device)
    summary, flight = final_evaluation(trained, actor, normalizer, cfg.episodes, cfg.seed)
    folder = Path(cfg.checkpoint).parent
    write_json(folder / "evaluation.json", summary)
    plot_flight(flight, folder / "evaluation.png", control_dt=trained.env.control_dt)
    print_summary(summary, folder)


if __name__ == "__main__":
    main()
