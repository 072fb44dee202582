"""The runs that put the paper on trial: methods and their variants, tasks, steps and seeds."""

from __future__ import annotations

from dataclasses import dataclass

SEEDS = (42, 0, 1, 2, 3)  # reported; those from 100 up are for the search
SEARCH_SEED = 100
LEARNING_RATES = (1e-3, 3e-3, 1e-2, 3e-2)  # of the actor: the same four for every method on every task
OWN_STEPS = 491_520, 3_932_160  # the same for a task of your own
SEARCH_FRACTION = {"hovering": 1.0, "tracking": 1.0, "landing": 0.5, "racing": 0.25}  # of a run's steps
EVALUATIONS = 40  # at most, along a run: the points of its curve
DYNAMICS = "priority mixer"  # of runs that are flown now; final.csv names that of each run

STEPS = {  # of a run, for the first-order methods and for PPO, which has more of them, since its steps are cheaper
    "hovering": (245_760, 1_966_080),
    "tracking": (491_520, 3_932_160),
    "landing": (983_040, 3_932_160),
    "racing": (6_144_000, 16_384_000),
}
TASKS = tuple(STEPS)
EPISODE = {"hovering": 256, "tracking": 512, "landing": 256, "racing": 512}
# What the recipes have taken on since the trial, and the trial goes without.
AS_THEN = ("env.event_discount=null", "actor.average=null", "eval.episodes=null")
RACING_AS_THEN = (  # of the first-order methods
    "loss.clip_action_gradient=null",
    *("actor.scale_init=0.3", "actor.learn_scale=true", "actor.noise_correlation=0"),
)
PPO_AS_THEN = (
    *("num_envs=256", "horizon=64", "actor.max_kl=null", "actor.noise_correlation=0"),
    *("actor.schedule=linear", "loss.max_importance_ratio=null", "loss.entropy_bonus=false", "critic.lmbda=0.95"),
    *("actor.betas=[0.9,0.999]", "critic.betas=[0.9,0.999]", "critic.lr=1e-3", "critic.final_lr=1e-5"),
)
RACING = ("env.reward=position", "actor.input_scale=1", "critic.num_cells=[128,128]", "gamma=0.98")  # for all methods


@dataclass(frozen=True)
class Variant:
    """A method or a change of it: its recipe, its name in figures and tables, and its overrides."""

    algorithm: str
    label: str
    overrides: tuple[str, ...] = ()
    horizon: int | str | None = None  # another number of steps, or "episode"; steps per iteration stay the same
    searched: bool = False  # its learning rate is searched for; the others take that of their method
    rate: float = 1.0  # factor of that learning rate


METHODS = {
    "abpt": Variant("abpt", "ABPT", searched=True),
    "shac": Variant("shac", "SHAC", searched=True),
    "bptt": Variant("bptt", "BPTT", searched=True),
    "ppo": Variant("ppo", "PPO", PPO_AS_THEN, searched=True),
}
VARIANTS = {
    **METHODS,
    # As published with the paper: BPTT through whole episodes, SHAC without the gradient of its terminal value.
    "bptt-episode": Variant("bptt", "BPTT, whole episodes", horizon="episode"),
    "shac-cut": Variant("shac", "SHAC, terminal gradient cut", ("loss.terminal_gradient=false",)),
    # The objective of Xu et al.: the target critic bootstraps, and the sum is divided by the horizon. Horizon,
    # restarts, networks and optimisers stay those of the recipe.
    "shac-xu": Variant(
        "shac", "SHAC as in Xu et al. 2022", ("loss.target_bootstrap=true", "loss.average_over_horizon=true")
    ),
    # Ablation. Without visited states each horizon continues the last one; with restarts some are reset.
    "abpt-no-0-step": Variant("abpt", "ABPT without 0-step return", ("loss.zero_step_return=false",)),
    "abpt-no-n-step": Variant("abpt", "ABPT without N-step return", ("loss.n_step_return=false",)),
    "abpt-restarts": Variant("abpt", "ABPT, restarts instead of visited states", ("buffer.fraction=null",)),
    # ABPT once more, for comparison with what is flown under the same dynamics.
    "abpt-now": Variant("abpt", "ABPT, present dynamics"),
    "abpt-no-visited": Variant("abpt", "ABPT without visited states", ("buffer.fraction=null", "restart_fraction=0")),
    # Relaxed gate bonus.
    **{
        f"{name}-{bonus}": Variant(name, f"{name.upper()}, {bonus} bonus", (f"env.gate_bonus={bonus}",))
        for bonus in ("log", "reciprocal")
        for name in ("bptt", "shac")
    },
    # The other reward of racing.
    **{
        f"{name}-velocity": Variant(
            name, f"{x.label}, velocity reward", (*x.overrides, "env.reward=velocity"), searched=True
        )
        for name, x in METHODS.items()
    },
    # Added when all five seeds of the other four were complete.
    "abpt-no-0-step-velocity": Variant(
        "abpt", "ABPT without 0-step return, velocity reward", ("loss.zero_step_return=false", "env.reward=velocity")
    ),
    # Settings in which the paper's text and its published code differ.
    "abpt-entropy": Variant("abpt", "ABPT, entropy bonus", ("loss.alpha=auto",)),
    **{
        f"{name}-horizon-{steps}": Variant(name, f"{name.upper()}, horizon {steps}", horizon=steps)
        for name in ("abpt", "shac")
        for steps in (32, 96)
    },
    # Better critics: the recipes have 4 updates in an iteration (landing 16, racing 8), and the paper 10. Added after
    # the first seeds of the ablation.
    "abpt-critic": Variant("abpt", "ABPT, 64 critic updates", ("critic.updates=64",)),
    # Lower learning rates than the search found. Added after the first seeds of the main experiment.
    **{f"{x}-slow": Variant(x, f"{x.upper()}, 0.3 of the rate", rate=0.3) for x in ("abpt", "shac", "bptt")},
}


def on(tasks: tuple[str, ...], *variants: str) -> dict[str, tuple[str, ...]]:
    return dict.fromkeys(variants, tasks)


EXPERIMENTS = {  # variants and their tasks, in the order in which they are run
    "main": on(TASKS, *METHODS),
    "published": on(TASKS, "bptt-episode", "shac-cut") | on(("landing", "racing"), "shac-xu"),
    "ablation": on(TASKS, "abpt-no-0-step", "abpt-no-n-step", "abpt-restarts"),
    "dynamics": on(TASKS, "abpt-now", "abpt-no-visited"),
    "reward": on(("racing",), *(f"{name}-velocity" for name in METHODS), "abpt-no-0-step-velocity"),
    "relaxation": on(("racing",), "bptt-log", "shac-log", "bptt-reciprocal", "shac-reciprocal"),
    "differences": on(
        ("landing", "racing"),
        *("abpt-entropy", "abpt-horizon-32", "abpt-horizon-96", "shac-horizon-32", "shac-horizon-96"),
    ),
    "critic": on(TASKS, "abpt-critic"),
    "rate": on(TASKS, "abpt-slow", "shac-slow", "bptt-slow"),
}


@dataclass(frozen=True)
class Job:
    """One run. With a learning rate of its own it belongs to the search."""

    task: str
    variant: str
    seed: int
    lr: float | None = None

    @property
    def name(self) -> str:
        search = "" if self.lr is None else f"/lr{self.lr:g}"
        return f"{self.task}/{self.variant}{search}/seed{self.seed}"

    @property
    def key(self) -> tuple[str, str, str]:
        """Its variant, learning rate and seed, as the results name them; a reported run names no rate."""
        return self.variant, "" if self.lr is None else f"{self.lr:g}", str(self.seed)

    @property
    def rate_of(self) -> str:
        """The variant whose learning rate it takes: that of its method, under the same reward."""
        variant = VARIANTS[self.variant]
        reward = "-velocity" if "env.reward=velocity" in variant.overrides else ""
        return self.variant if variant.searched else variant.algorithm + reward

    def overrides(self, lr: float) -> list[str]:
        """Give the overrides of its recipe's configuration, with the learning rate that the search found."""
        variant = VARIANTS[self.variant]
        steps = STEPS.get(self.task, OWN_STEPS)[variant.algorithm == "ppo"]
        if self.lr is not None:
            steps, lr = int(SEARCH_FRACTION.get(self.task, 1.0) * steps), self.lr
        lr *= variant.rate
        racing = [x for x in RACING if variant.algorithm != "bptt" or "critic" not in x]
        racing += RACING_AS_THEN if variant.algorithm != "ppo" else ()
        horizon = EPISODE.get(self.task, 256) if variant.horizon == "episode" else variant.horizon
        batch = 128 * 128 if self.task == "racing" else 64 * 64  # steps in an iteration of the first-order methods
        return [
            f"task={self.task}",
            f"seed={self.seed}",
            f"total_steps={steps}",
            f"actor.lr={lr:g}",
            f"actor.final_lr={lr / 100:g}",
            *AS_THEN,
            *(racing if self.task == "racing" else ()),
            *variant.overrides,
            *([f"horizon={horizon}", f"num_envs={round(batch / horizon)}"] if horizon else ()),
        ]


def search_jobs(tasks: tuple[str, ...], variants: set[str], rates: tuple[float, ...] = LEARNING_RATES) -> list[Job]:
    """List the search for the learning rates of these variants: every rate, on every task."""
    searched = [name for name in VARIANTS if name in variants and VARIANTS[name].searched]
    runs = [(task, name) for task in tasks for name in searched if name in METHODS or task == "racing"]
    return [Job(task, name, SEARCH_SEED, lr) for task, name in runs for lr in rates]


def jobs(experiments: tuple[str, ...], tasks: tuple[str, ...], seeds: tuple[int, ...]) -> list[Job]:
    """List the runs to report: three seeds of everything first; a task of your own gets what all the paper's get."""
    return [
        Job(task, variant, seed)
        for some in (seeds[:3], seeds[3:])
        for experiment in experiments
        for seed in some
        for task in tasks
        for variant, of in EXPERIMENTS[experiment].items()
        if task in of or (task not in TASKS and of == TASKS)
    ]
