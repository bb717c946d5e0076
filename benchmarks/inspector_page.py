"""Speed of the inspector's page in headless Chromium: turning clouds, and a change of a parameter.

    python -m benchmarks.inspector_page [--device cuda:0] [--out FILE.json]

The window holds 1 million events, of which each cloud draws 100,000. A change counts until the browser has drawn the
new cloud and the new image; the sharpness on the page is compared with that of a second inspector.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import secrets
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.studies.machine import machine
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.layout import SETTABLE
from amiwarp.viewer.panel import Panel
from amiwarp.viewer.serve import serve
from benchmarks.inspector import made, recorded

CHANGES = 15
MOST_MS, LEAST_FRAMES = 150.0, 10.0
"""Longest time of a change [ms], and smallest number of frames per second, that count as good."""
TURN = """async (seconds) => {
  const canvas = document.querySelector('.clouds canvas'), box = canvas.getBoundingClientRect();
  const at = (type, x) => canvas.dispatchEvent(new PointerEvent(type, { clientX: x, clientY: 300, pointerId: 1 }));
  canvas.setPointerCapture = () => {};
  at('pointerdown', box.left + 100);
  const first = Number(canvas.dataset.frames), begin = performance.now();
  for (let k = 0; performance.now() < begin + 1e3 * seconds; k++) {
    at('pointermove', box.left + 100 + 4 * k);
    await new Promise(requestAnimationFrame);
  }
  at('pointerup', box.left);
  return (Number(canvas.dataset.frames) - first) / (performance.now() - begin) * 1e3;
}"""
"""Program for the browser that turns the clouds, and returns the frames per second."""
CHANGE = """async (apex) => {
  const shown = () => [
    document.querySelector('.clouds canvas').dataset.frames, document.querySelector('#image-after').dataset.images,
  ];
  const [before, begin] = [shown(), performance.now()];
  trame.trigger('slide', ['apex', apex]);
  while (shown().some((each, k) => each === before[k])) await new Promise(requestAnimationFrame);
  return performance.now() - begin;
}"""
"""Program for the browser that changes the apex angle. It returns the time until cloud and image are drawn [ms].
The sharpness comes with them, in one message."""


def measure(url: str) -> dict[str, Any]:
    """Return frame rate, times of changes and the last sharpness of the page at ``url``."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        arguments = ["--no-sandbox", "--disable-gpu"]
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=arguments
        )
        page = browser.new_page(viewport={"width": 1366, "height": 768})
        page.goto(url)
        page.locator("#events").filter(has_text="drawn").wait_for()
        page.locator("#do-whole").click()
        page.locator("#events").filter(has_text="100,000 of these drawn").wait_for()
        page.wait_for_timeout(3000)  # the sharpness curve
        fps = page.evaluate(TURN, 3.0)
        times = [page.evaluate(CHANGE, 1.03 + 0.05 * k) for k in range(CHANGES)]
        page.wait_for_timeout(1000)
        sharpness = float(page.locator("#sharpness").inner_text().split("→")[1].split()[0])
        browser.close()
    return {"frames_per_s": fps, "change_ms": float(np.median(times)), "change_ms_slowest": max(times),
            "sharpness": sharpness}  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    recording, found = (
        recorded(made(1_000_000, 0.2)),
        {"machine": machine(args.device), "device": args.device},
    )

    def inspector() -> Inspector:
        opened = Inspector(recording, device=args.device)
        opened.window = 0, 200_000
        return opened

    async def run() -> None:
        async def show(url: str) -> None:
            found.update(await asyncio.to_thread(measure, url))
            serving.cancel()

        tasks: list[asyncio.Task[None]] = []

        def ready(url: str) -> None:
            tasks.append(asyncio.get_running_loop().create_task(show(url)))

        def build(server: Any) -> Callable[[], None]:
            return Panel(server, inspector()).close

        token = secrets.token_urlsafe(16)
        serving = asyncio.create_task(serve(build, settable=SETTABLE, token=token, ready=ready))
        await asyncio.wait([serving])
        await asyncio.gather(*tasks)

    asyncio.run(run())
    known = inspector()
    known.set(replace(known.knobs, apex=float(np.radians(1.03 + 0.05 * (CHANGES - 1)))))
    known.open(0, 200_000)
    error = abs(known.show().sharpness_after - found["sharpness"])
    found |= {
        "ok": error < 2e-3
        and found["change_ms"] <= MOST_MS
        and found["frames_per_s"] >= LEAST_FRAMES
    }
    print(json.dumps(found, indent=1))
    if args.out:
        args.out.write_text(json.dumps(found, indent=1) + "\n")
    return int(not found["ok"])


if __name__ == "__main__":
    raise SystemExit(main())
