"""Fly the best policy of a training run: deterministic, over fresh episodes.

python recipes/evaluate.py checkpoint=outputs/.../checkpoint.pt
"""

from pathlib import Path

import hydra
import torch
from checkpoints import write_json
from common import build_env, final_evaluation, load_policy
from omegaconf import DictConfig
from run import draw_flight, print_summary, publish_flight


@hydra.main(config_path="config", config_name="evaluate", version_base=None)
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    trained, actor, normalizer = load_policy(Path(cfg.checkpoint), cfg.device)
    summary, flight = final_evaluation(trained, actor, normalizer, cfg.episodes, cfg.seed)
    folder = Path(cfg.checkpoint).parent
    write_json(folder / "evaluation.json", summary)
    path = folder / "evaluation"
    draw_flight(flight, path, trained.env.control_dt)
    publish_flight(flight, path.with_suffix(".pdf"), path.with_suffix(".html"), build_env(trained, 1, 0))
    print_summary(summary, folder)


if __name__ == "__main__":
    main()
