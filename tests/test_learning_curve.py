"""Learning curves from the CSV file of a run."""

import numpy as np
import pytest

from torchrl_quad import HoveringEnv
from torchrl_quad.render import plot_learning_curve


@pytest.fixture
def draw(tmp_path):
    """Draws a CSV file with these lines; returns the axes."""

    def draw(*rows, **options):
        (tmp_path / "metrics.csv").write_text("\n".join((*rows, "")))
        return plot_learning_curve(tmp_path / "metrics.csv", tmp_path / "curve.png", **options).axes

    return draw


def test_metrics_are_drawn_in_their_units_in_the_order_of_the_task(draw):
    rows = (
        "steps,time/seconds,eval/position_error,eval/return,eval/top_speed,eval/solved,train/loss",
        "100,1.0,1.0,5.0,3.0,0.0,9.0",
        "200,2.0,0.02,20.0,4.0,1.0,8.0",
    )
    shown = {
        axis.get_ylabel(): axis.lines[0].get_xydata().tolist() for axis in draw(*rows, metrics=HoveringEnv.metric_info)
    }
    assert list(shown) == ["return", "episodes solved [%]", "position error [cm], median", "top speed"]
    assert shown["episodes solved [%]"] == [[1, 0], [2, 100]]
    assert shown["position error [cm], median"] == [[1, 100], [2, 2]]
    labels = [axis.get_ylabel() for axis in draw(*rows)]
    assert labels == ["return", "episodes solved [%]", "position error", "top speed"]


@pytest.mark.parametrize("evaluations", [2, 3, 60])
def test_the_axis_of_steps_is_right_at_every_evaluation_though_the_first_iteration_compiled(draw, evaluations):
    steps = 1000 * np.arange(1, evaluations + 1)
    seconds = 30.0 + 0.5 * np.arange(evaluations)  # 30 s for the first, half a second for each other
    rows = [f"{n},{s},{n / 100}" for n, s in zip(steps, seconds, strict=True)]
    (axis,) = draw("steps,time/seconds,eval/return", *rows)
    (upper,) = axis.child_axes
    # Where a number of steps is on the upper axis, its second is on the lower one, and so at the margins.
    for count, second in zip((0, *steps, steps[-1] + 1000), (0, *seconds, seconds[-1] + 0.5), strict=True):
        x, _ = upper.transData.transform((count, 0))
        assert x == pytest.approx(axis.transData.transform((second, 0))[0], abs=0.5)  # [pixels]


def test_rows_before_the_first_step_and_rows_of_one_instant_need_no_axis_of_steps(draw):
    (axis,) = draw("steps,time/seconds,eval/return", "0,0.0,5.0")
    assert not axis.child_axes
    (axis,) = draw("steps,time/seconds,eval/return", "0,0.0,5.0", "100,2.0,6.0", "100,2.0,6.5", "300,3.0,7.0")
    x, _ = axis.child_axes[0].transData.transform((200, 0))
    assert x == pytest.approx(axis.transData.transform((2.5, 0))[0], abs=0.5)


@pytest.mark.parametrize("rows", [["0,0.0,5.0,,"], ["0,0.0,5.0,,none", "100,1.0,6.0,0.5,none"]])
def test_a_learning_curve_has_gaps_where_cells_are_empty(draw, rows):
    axes = draw("steps,time/seconds,eval/return,eval/solved,note", *rows)
    shown = axes[1].lines[0].get_ydata()
    assert len(shown) == len(rows) and np.isnan(shown[0])


@pytest.mark.parametrize(
    ("rows", "message"),
    [(["steps,eval/return"], "has no row yet"), (["steps", "1"], "needs the columns .* has steps")],
)
def test_a_learning_curve_of_nothing_is_refused(draw, rows, message):
    with pytest.raises(ValueError, match=message):
        draw(*rows)
