"""What is run to put the paper on trial: methods and their variants, on which tasks, with how many steps and seeds."""

from __future__ import annotations

from dataclasses import dataclass

SEEDS = (42, 0, 1, 2, 3)  # reported; those from 100 up are for the search
SEARCH_SEED = 100
LEARNING_RATES = (1e-3, 3e-3, 1e-2, 3e-2)  # of the actor: the same four for every method on every task
SEARCH_FRACTION = {"hovering": 1.0, "tracking": 1.0, "landing": 0.5, "racing": 0.25}  # of a run's steps
EVALUATIONS = 40  # along a run, for its curve

STEPS = {  # of a run, for the first-order methods and for PPO, which has more of them in about the same time
    "hovering": (245_760, 1_966_080),
    "tracking": (491_520, 3_932_160),
    "landing": (983_040, 3_932_160),
    "racing": (6_144_000, 16_384_000),
}
TASKS = tuple(STEPS)
RACING_NETWORKS = ("actor.input_scale=10", "critic.num_cells=[128,128]", "gamma=0.98")  # the same for every method


@dataclass(frozen=True)
class Variant:
    """A method, or a change of one: the recipe, what it is called in figures, and what differs."""

    algorithm: str
    label: str
    overrides: tuple[str, ...] = ()


VARIANTS = {
    "abpt": Variant("abpt", "ABPT"),
    "shac": Variant("shac", "SHAC"),
    "bptt": Variant("bptt", "BPTT"),
    "ppo": Variant("ppo", "PPO"),
    # Ablation.
    "abpt-no-0-step": Variant("abpt", "ABPT without 0-step return", ("loss.zero_step_return=false",)),
    "abpt-no-n-step": Variant("abpt", "ABPT without N-step return", ("loss.n_step_return=false",)),
    "abpt-no-visited": Variant("abpt", "ABPT without visited states", ("buffer.fraction=null",)),
    # Relaxed gate bonus.
    "bptt-log": Variant("bptt", "BPTT, log bonus", ("env.gate_bonus=log",)),
    "shac-log": Variant("shac", "SHAC, log bonus", ("env.gate_bonus=log",)),
    "bptt-reciprocal": Variant("bptt", "BPTT, reciprocal bonus", ("env.gate_bonus=reciprocal",)),
    "shac-reciprocal": Variant("shac", "SHAC, reciprocal bonus", ("env.gate_bonus=reciprocal",)),
    # The other reward of racing.
    "abpt-position": Variant("abpt", "ABPT, position reward", ("env.reward=position",)),
    "shac-position": Variant("shac", "SHAC, position reward", ("env.reward=position",)),
    "bptt-position": Variant("bptt", "BPTT, position reward", ("env.reward=position",)),
    "ppo-position": Variant("ppo", "PPO, position reward", ("env.reward=position",)),
    # Where the text and the published settings differ.
    "shac-cut": Variant("shac", "SHAC, terminal gradient cut", ("loss.terminal_gradient=false",)),
    "abpt-entropy": Variant("abpt", "ABPT, entropy bonus", ("loss.alpha=auto",)),
    "abpt-horizon-32": Variant("abpt", "ABPT, horizon 32", ("horizon=32",)),
    "abpt-horizon-96": Variant("abpt", "ABPT, horizon 96", ("horizon=96",)),
    "shac-horizon-32": Variant("shac", "SHAC, horizon 32", ("horizon=32",)),
    "shac-horizon-96": Variant("shac", "SHAC, horizon 96", ("horizon=96",)),
}

EXPERIMENTS = {  # name: variants and tasks, in the order in which they are run
    "main": (("abpt", "shac", "bptt", "ppo"), TASKS),
    "ablation": (("abpt-no-0-step", "abpt-no-n-step", "abpt-no-visited"), TASKS),
    "relaxation": (("bptt-log", "shac-log", "bptt-reciprocal", "shac-reciprocal"), ("racing",)),
    "reward": (("abpt-position", "shac-position", "bptt-position", "ppo-position"), ("racing",)),
    "differences": (
        ("shac-cut", "abpt-entropy", "abpt-horizon-32", "abpt-horizon-96", "shac-horizon-32", "shac-horizon-96"),
        ("landing", "racing"),
    ),
}


@dataclass(frozen=True)
class Job:
    """One run. A learning rate that is given makes it one of the search."""

    task: str
    variant: str
    seed: int
    lr: float | None = None

    @property
    def name(self) -> str:
        """What its folder is called."""
        search = "" if self.lr is None else f"/lr{self.lr:g}"
        return f"{self.task}/{self.variant}{search}/seed{self.seed}"

    def overrides(self, lr: float) -> list[str]:
        """Of its recipe's configuration, with the learning rate that the search has found."""
        variant = VARIANTS[self.variant]
        steps = STEPS[self.task][variant.algorithm == "ppo"]
        if self.lr is not None:
            steps, lr = int(SEARCH_FRACTION[self.task] * steps), self.lr
        networks = [x for x in RACING_NETWORKS if variant.algorithm != "bptt" or "critic" not in x]
        return [
            f"task={self.task}",
            f"seed={self.seed}",
            f"total_steps={steps}",
            f"actor.lr={lr:g}",
            f"actor.final_lr={lr / 100:g}",
            *(networks if self.task == "racing" else ()),
            *variant.overrides,
        ]


def search_jobs(tasks: tuple[str, ...], rates: tuple[float, ...] = LEARNING_RATES) -> list[Job]:
    """The search for learning rates: every method, every task, every rate."""
    methods, _ = EXPERIMENTS["main"]
    return [Job(task, method, SEARCH_SEED, lr) for task in tasks for method in methods for lr in rates]


def jobs(experiments: tuple[str, ...], tasks: tuple[str, ...], seeds: tuple[int, ...]) -> list[Job]:
    """The runs to report: three seeds of everything, before the others of anything."""
    chosen = [(names, [task for task in of if task in tasks]) for names, of in map(EXPERIMENTS.get, experiments)]
    return [
        Job(task, variant, seed)
        for some in (seeds[:3], seeds[3:])
        for variants, of in chosen
        for seed in some
        for task in of
        for variant in variants
    ]
