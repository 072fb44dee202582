"""Fit a drone to logs of its flights: its parameters with intervals, as files that environments and recipes take.

python recipes/identify.py 'logs=[flight1.csv, flight2.csv]' drone=crazyflie mass=0.027
"""

from omegaconf import DictConfig, OmegaConf

from torchrl_quad.deploy import frames
from torchrl_quad.files import make_folder
from torchrl_quad.identification import identify, read_log
from torchrl_quad.training.launch import recipe


@recipe("identify")
def main(cfg: DictConfig) -> None:
    settings = OmegaConf.to_container(cfg)
    convention = settings["convention"] and frames.named(settings["convention"])
    reading = {"convention": convention, **(settings["reading"] or {})}
    logs = [read_log(path, settings["columns"], **reading) for path in cfg.logs]
    for log in logs:
        print(log)
    known = dict(settings["known"] or {}) | ({} if cfg.mass is None else {"mass": cfg.mass})
    options = {name: cfg[name] for name in ("past", "horizon", "iterations", "draws", "seed")}
    folder = make_folder(cfg.folder)
    options |= {"progress": True, "checkpoint": folder / "checkpoint.json"}
    result = identify(logs, settings["drone"], known, settings["fields"], **options)
    print(result)
    result.save(folder)
    print(f"{folder}: python recipes/abpt.py env.drone={folder}/drone.yaml env.randomize={folder}/randomization.yaml")


if __name__ == "__main__":
    main()
