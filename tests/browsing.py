"""Pages in a browser without a network."""

import os
import shutil
import time

import numpy as np
import pytest

TIMEOUT = 120_000  # [ms]; the machine may be busy with other tests


@pytest.fixture(scope="module")
def browser():
    chromium = shutil.which("chromium")
    if chromium is None:
        message = "Replays are tested in a browser, and there is no chromium (Debian: apt install chromium)."
        if os.environ.get("REQUIRE_BROWSER") == "1":
            pytest.fail(message)
        pytest.skip(message)
    from playwright.sync_api import sync_playwright

    on_the_cpu = "--use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader"  # WebGL; all else is quicker so:
    on_the_cpu += " --disable-gpu-rasterization --disable-gpu-compositing"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", *on_the_cpu.split()])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def open_page(browser):
    """Opens a replay offline; a request that leaves the machine, and any error, fails the test that closes it."""

    class Replay:
        def __init__(self, path):
            self.context = browser.new_context(offline=True, viewport={"width": 900, "height": 480})
            self.page = self.context.new_page()
            self.page.set_default_timeout(TIMEOUT)
            self.wrong = []
            self.page.on("console", lambda m: self.wrong.append(m.text) if m.type == "error" else None)
            self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
            self.page.on("request", lambda r: None if r.url.startswith("file://") else self.wrong.append(r.url))
            self.page.goto(path.as_uri())
            self.page.wait_for_selector("body[data-ready]")

        def trace(self, name, of="space"):
            """The points (n, k) of a trace as they are plotted: x, y and, in space, z."""
            script = """([of, name]) => {
                const trace = document.getElementById(of).data.find((trace) => trace.name === name);
                return ["x", "y", "z"].filter((key) => trace[key])
                    .map((key) => Array.from(trace[key], (value) => Number.isFinite(value) ? value : null));
            }"""
            return np.array(self.page.evaluate(script, [of, name]), dtype=float).T

        def bodies(self):
            """The points of each body (num_envs, points, 3); the first is the centre of the drone."""
            points = self.trace("body")
            return points.reshape(self.page.locator("#environment option").count() - 1, -1, 3)

        def picture(self):
            return self.page.locator("#space").screenshot(timeout=TIMEOUT)

        def scrub(self, frame):
            self.page.locator("#time").fill(str(frame))

        def step(self):
            return int(self.page.locator("#time").input_value())

        def wait(self, holds):
            """Waits until a condition on the step of the slider holds."""
            # Not page.wait_for_function, which evaluates a string in the page: its policy does not allow that.
            deadline = time.monotonic() + TIMEOUT / 1000
            while not holds(self.step()):
                assert time.monotonic() < deadline
                self.page.wait_for_timeout(20)

        def series(self):
            """The names of the curves, and of the panels."""
            return self.page.evaluate(
                "() => { const {data, layout} = document.getElementById('series');"
                "return [data.map((t) => t.name), layout.annotations.map((a) => a.text.replace(/<[^>]*>/g, ''))]; }"
            )

        def layout(self, name):
            """An entry of the layout of the panels, such as "yaxis4.type", as plotly uses it."""
            script = "(name) => name.split('.').reduce((x, k) => x[k], document.getElementById('series')._fullLayout)"
            return self.page.evaluate(script, name)

        def close(self):
            self.context.close()
            assert not self.wrong

    return Replay
