"""Frames per second of the inspector's clouds with a graphics card, in headless Chromium.

    python benchmarks/inspector_card.py [--points 1000000] [--seconds 5] [--chromium FILE] [--vue FILE] [--out FOLDER]

It needs Python and Chromium only, so that it runs on a GPU machine where amiwarp cannot be installed: carry Chromium
(``chromium-headless-shell`` and the libraries of its ``ldd`` are 84 MB packed), this file, the folder of the page and
``vue.global.js`` of ``trame_client/module/vue3-www``. The page's own component shows two clouds, which are turned as
by a mouse. A frame counts when it is finished: one of its pixels is read. Four ways to reach the card are tried. For
each it prints the renderer's name, whether the page takes it for a card, and the frames per second, and writes the
picture and Chromium's messages.
"""

from __future__ import annotations

import argparse
import http.server
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import tempfile
import threading
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[1] / "amiwarp/viewer/page"
WAYS = {
    "vulkan": ("--use-angle=vulkan", "--enable-features=Vulkan", "--disable-vulkan-surface"),
    "egl": ("--use-gl=angle", "--use-angle=gl-egl"),
    "default": (),
    "software": ("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
}
"""Options of Chromium for each way to draw."""
OPTIONS = (
    "--headless=new", "--no-sandbox", "--ignore-gpu-blocklist", "--no-first-run", "--disable-dev-shm-usage",
    "--disable-frame-rate-limit", "--disable-gpu-vsync", "--window-size=1366,768", "--enable-logging=stderr",
)  # fmt: skip
LONGEST_S = 90.0
"""Time after which a way has failed."""
HTML = """<!doctype html><meta charset="utf-8"><style>
html, body, #app { margin: 0; height: 100%; } #app { --paper: #ffffff; --ink: #1f2933; }
.clouds, .clouds canvas { display: block; width: 100%; height: 100%; }
</style><div id="app"></div><script src="vue.global.js"></script><script type="module">
import { EventClouds } from './page/clouds.js';
const query = new URLSearchParams(location.search), n = Number(query.get('points'));
const bytes = (array) => new Uint8Array(array.buffer), empty = new Uint8Array(0);
let seed = 1, card = null;
const random = () => (seed = (seed * 16807) % 2147483647) / 2147483647;
const before = new Float32Array(2 * n), after = new Float32Array(2 * n);
const third = new Float32Array(n), colours = new Uint32Array(n);
for (let k = 0; k < n; k++) {
  const ring = 20 + 30 * Math.floor(4 * random()), at = 6.2832 * random();
  third[k] = 360 * random();
  after[2 * k] = 320 + 1.5 * ring * Math.cos(at);
  after[2 * k + 1] = 240 + ring * Math.sin(at);
  before[2 * k] = after[2 * k] + 8 * Math.cos(third[k] / 57.3);
  before[2 * k + 1] = after[2 * k + 1] + 8 * Math.sin(third[k] / 57.3);
  colours[k] = random() < 0.5 ? 0xff005ed5 : 0xffb27200;
}
const shown = {
  before: bytes(before), after: bytes(after), third: bytes(third), thirdBefore: bytes(third),
  coloursBefore: bytes(colours), coloursAfter: bytes(colours), orbit: empty, column: empty, box: [60, 60, 580, 420],
  axis: { low: 0, high: 360, title: 'prism angle θ (°)' }, titles: [[0, 'as recorded'], [1, 'compensated']],
  view: ['free', 0], dot: 2, opacity: 1, overlaid: false, dark: false, picked: -1, slice: [0, 1], beside: false,
  onCard: (found) => { card = found; },
};
window.Vue.createApp({ render: () => window.Vue.h(EventClouds, shown) }).mount('#app');
const drawn = () => new Promise(requestAnimationFrame), send = (body) => fetch('result', { method: 'POST', body });
(async () => {
  const gl = document.createElement('canvas').getContext('webgl2');
  const info = gl && gl.getExtension('WEBGL_debug_renderer_info');
  const renderer = gl ? gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER) : 'no WebGL 2';
  for (let k = 0; k < 30; k++) await drawn();
  const canvas = document.querySelector('.clouds canvas'), { width, height } = canvas;
  const at = (type, x) => canvas.dispatchEvent(new PointerEvent(type, { clientX: x, clientY: 300, pointerId: 1 }));
  canvas.setPointerCapture = () => {};
  at('pointerdown', 100);
  const first = Number(canvas.dataset.frames), begin = performance.now();
  for (let k = 0; performance.now() < begin + 1e3 * Number(query.get('seconds')); k++) {
    at('pointermove', 100 + 4 * k);
    await drawn();
    canvas.getContext('2d').getImageData(0, 0, 1, 1);
  }
  const frames_per_s = (Number(canvas.dataset.frames) - first) / (performance.now() - begin) * 1e3;
  await fetch('picture', { method: 'POST', body: await new Promise((done) => canvas.toBlob(done)) });
  await send(JSON.stringify({ renderer, card, points: n, width, height, frames_per_s }));
})().catch((error) => send(JSON.stringify({ error: String(error.stack) })));
</script>
"""


class Server(http.server.ThreadingHTTPServer):
    """Server of the page's files, which takes its results."""

    def __init__(self, folder: Path) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.folder = folder
        self.done = threading.Event()
        self.picture, self.result = b"", b""


class Handler(http.server.SimpleHTTPRequestHandler):
    """Answers to the page's requests."""

    server: Server

    def __init__(self, *args: Any) -> None:
        super().__init__(*args, directory=str(args[2].folder))

    def do_POST(self) -> None:
        """Take the picture, then the result."""
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.send_response(204)
        self.end_headers()
        if self.path == "/picture":
            self.server.picture = body
        else:
            self.server.result = body
            self.server.done.set()

    def log_message(self, *args: Any) -> None:
        """Print nothing."""


def vue() -> Path | None:
    """Return the file of Vue that trame has, if it is installed."""
    found = importlib.util.find_spec("trame_client")
    return Path(str(found.origin)).parent / "module/vue3-www/vue.global.js" if found else None


def measure(args: argparse.Namespace, folder: Path, way: str) -> dict[str, Any]:
    """Return what the page found in one way, and write its picture and Chromium's messages."""
    server, log = Server(folder), args.out / f"{way}.log"
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{server.server_port}/bench.html?points={args.points}&seconds={args.seconds}"
    with tempfile.TemporaryDirectory() as home, log.open("wb") as messages:
        command = [args.chromium, *OPTIONS, f"--user-data-dir={home}", *WAYS[way], url]
        environment = {**os.environ, "HOME": home}
        chromium = subprocess.Popen(
            command, env=environment, stdout=messages, stderr=messages, start_new_session=True
        )
        ended = server.done.wait(LONGEST_S)
        os.killpg(chromium.pid, signal.SIGKILL)
        chromium.wait()
    server.shutdown()
    (args.out / f"{way}.png").write_bytes(server.picture)
    found = (
        json.loads(server.result)
        if ended
        else {"error": f"no answer in {LONGEST_S:g} s; see {log}"}
    )
    return {"way": way, **found}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--chromium", default=shutil.which("chromium"))
    parser.add_argument("--vue", type=Path, default=vue())
    parser.add_argument("--out", type=Path, default=Path("."))
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "bench.html").write_text(HTML, encoding="utf-8")
        shutil.copytree(PAGE, folder / "page")
        shutil.copy(args.vue, folder / "vue.global.js")
        for way in WAYS:
            print(json.dumps(measure(args, folder, way)), flush=True)


if __name__ == "__main__":
    main()
