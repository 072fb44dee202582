"""Fly the best policy of a training run: deterministic, over fresh episodes.

python recipes/evaluate.py checkpoint=outputs/.../checkpoint.pt
"""

from pathlib import Path

import torch
from omegaconf import DictConfig

from torchrl_quad.training.building import build_env, task_of
from torchrl_quad.training.drawing import draw_flight, publish_flight
from torchrl_quad.training.evaluation import final_evaluation, load_policy, print_summary, title, write_summary
from torchrl_quad.training.launch import recipe


@recipe("evaluate")
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    trained, actor, normalizer = load_policy(Path(cfg.checkpoint), cfg.device, cfg.trust)
    summary, flight = final_evaluation(trained, actor, normalizer, cfg.episodes, cfg.seed)
    folder, env = Path(cfg.checkpoint).parent, build_env(trained, 1, 0)
    write_summary(folder / "evaluation.json", summary)
    print_summary(summary, task_of(env).metric_info, folder)
    path = folder / "evaluation"
    draw_flight(flight, path, env, title(summary))
    publish_flight(flight, path.with_suffix(".pdf"), path.with_suffix(".html"), env, title(summary))


if __name__ == "__main__":
    main()
