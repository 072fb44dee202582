"""A view of a project on wandb's page, with what matters on top.

python recipes/workspace.py OWNER [PROJECT]

It needs an account, and `pip install wandb-workspaces`. Change the panels to your own taste, and run it again.
"""

import argparse

import wandb_workspaces.reports.v2 as panels
import wandb_workspaces.workspaces as ws


def line(title: str, *metrics: str, **options) -> panels.LinePlot:
    """Metrics over the control steps."""
    return panels.LinePlot(title=title, x="steps", y=list(metrics), **options)


def section(name: str, *content, is_open: bool = True) -> ws.Section:
    layout = ws.SectionLayoutSettings(columns=3, rows=1 + (len(content) - 1) // 3)
    return ws.Section(name=name, panels=list(content), is_open=is_open, layout_settings=layout)


def workspace(entity: str, project: str) -> ws.Workspace:
    return ws.Workspace(
        entity=entity,
        project=project,
        name="Drones at a glance",
        sections=[
            section(
                "How well it flies",
                line("Episodes solved", "eval/solved", range_y=(0.0, 1.0)),
                line("Return", "eval/return"),
                line("Crashes", "eval/crash", range_y=(0.0, 1.0)),
            ),
            section(
                "Flights", panels.MediaBrowser(media_keys=["eval/film", "eval/flight", "eval/replay"], num_columns=3)
            ),
            section(
                "How precisely",
                line("Position error [m]", "eval/position_error", log_y=True),
                line("Tracking RMSE [m]", "eval/tracking_rmse", log_y=True),
                line("Gates passed", "eval/gates_passed"),
            ),
            section(
                "Health of the training",
                line("Gradient norm before clipping", "grad/actor", "grad/critic", log_y=True),
                line("The critic and its targets", "train/pred_value", "train/target_value"),
                line("Explained variance", "train/explained_variance", range_y=(-1.0, 1.0)),
                line("Updates left out", "grad/skipped"),
                line("Cubes in which horizons start", "train/start_cells"),
                line("Steps per second", "time/steps_per_second"),
            ),
            section(
                "What the return is made of",
                panels.LinePlot(title="Terms of the reward", x="steps", metric_regex="reward/.*"),
                is_open=False,
            ),
        ],
        settings=ws.WorkspaceSettings(x_axis="steps"),
        runset_settings=ws.RunsetSettings(pinned_columns=[f"summary:best/{x}" for x in ("solved", "return", "crash")]),
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("entity", help="the owner of the project: a user or a team")
    parser.add_argument("project", nargs="?", default="torchrl_quad")
    workspace(**vars(parser.parse_args())).save()
