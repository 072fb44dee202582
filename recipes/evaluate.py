"""Fly the best policy of a training run: deterministic, over fresh episodes.

python recipes/evaluate.py checkpoint=outputs/.../checkpoint.pt
"""

from pathlib import Path

from omegaconf import DictConfig

from torchrl_quad.training.building import build_env, task_of
from torchrl_quad.training.drawing import draw_flight, publish_flight
from torchrl_quad.training.evaluation import final_evaluation, load_policy, report, title
from torchrl_quad.training.launch import recipe


@recipe("evaluate")
def main(cfg: DictConfig) -> None:
    trained, actor, normalizer = load_policy(Path(cfg.checkpoint), cfg.device, cfg.trust)
    summary, flight = final_evaluation(trained, actor, normalizer, cfg.episodes, cfg.seed)
    path, env = Path(cfg.checkpoint).with_name("evaluation"), build_env(trained, 1, 0)
    report(summary, task_of(env).metric_info, path.with_suffix(".json"))
    draw_flight(flight, path, env, title(summary))
    publish_flight(flight, path.with_suffix(".pdf"), path.with_suffix(".html"), env, title(summary))


if __name__ == "__main__":
    main()
