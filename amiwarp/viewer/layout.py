"""Widgets of the inspector's page and their arrangement."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from amiwarp.optics.models import MODELS
from amiwarp.viewer.choices import Axis, View

if TYPE_CHECKING:
    from amiwarp.viewer.panel import Panel

UNITS = {
    "apex": math.radians(1.0), "phase": math.radians(1.0), "clock_offset": 1.0, "tilt_x": math.radians(1.0),
    "tilt_y": math.radians(1.0), "rpm": 1.0,
}  # fmt: skip
"""Conversion from the page's units (angles in degrees) to the parameters' units (radians): factor per parameter."""
NAMES = tuple(UNITS)
"""Names of the prism parameters that have a slider."""
SLIDERS = (
    ("apex", "apex", "°", ("0", "apex_most", 0.005), None),
    ("phase", "phase θ_b", "°", ("-180", "180", 0.25), None),
    ("clock_offset", "clock offset Δt", "µs", ("-20000", "20000", 10), "has_encoder"),
    ("rpm", "speed", "rpm", ("-3000", "3000", 0.5), "!has_encoder"),
    ("tilt_x", "tilt x", "°", ("-5", "5", 0.05), "model == 'exact' || model == 'ellipse'"),
    ("tilt_y", "tilt y", "°", ("-5", "5", 0.05), "model == 'exact' || model == 'ellipse'"),
)
"""Sliders of the page: name, label, unit, (minimum, maximum, step), and the condition for showing the slider."""
SPEEDS = (0.01, 0.1, 0.5, 1)
"""Choices of the playback speed, relative to real time."""
KEYS = (
    ("ArrowRight", ("step", 1.0), "forward by one turn"),
    ("ArrowLeft", ("step", -1.0), "back by one turn"),
    (" ", ("play",), "play (or follow a live stream), or stop"),
    ("1", ("look_from", View.FREE.value), "view from the corner"),
    ("2", ("look_from", View.XY.value), "view along the third axis: x-y, the image"),
    ("3", ("look_from", View.X_AXIS.value), "view along y: x-θ"),
    ("4", ("look_from", View.Y_AXIS.value), "view along x: y-θ"),
    ("t", ("toggle_axis",), "third axis: angle or time"),
    ("o", ("toggle", "overlaid"), "side by side or overlaid"),
    ("d", ("toggle", "dark"), "light or dark"),
    ("c", ("calibrate",), "calibrate, or cancel"),
    ("a", ("accept",), "accept the result of the calibration"),
    ("s", ("save",), "save the calibration"),
    ("p", ("save_picture",), "save a picture of the clouds"),
    ("?", ("toggle", "help_shown"), "show or hide this help"),
)
"""Keys of the page: name of the key, method of the panel with its arguments, and help text."""
STYLE = """
html { overflow: hidden !important; }
.panel { display: grid; grid-template: 40px minmax(0, 1fr) 214px / minmax(0, 1fr) 318px; height: 100vh; outline: none; }
.panel > * { min-width: 0; min-height: 0; }
.bar { grid-column: 1 / 3; display: flex; align-items: center; gap: 14px; padding: 0 12px; font-size: 13px;
  border-bottom: 1px solid #8884; white-space: nowrap; overflow: hidden; }
.bar b { font-size: 15px; }
.grow { flex: 1; }
.cloud { position: relative; }
.said { position: absolute; left: 10px; right: 10px; bottom: 8px; z-index: 5; }
.hint { position: absolute; left: 12px; bottom: 6px; font-size: 12px; opacity: 0.75; pointer-events: none; }
.side { grid-row: 2 / 4; grid-column: 2; overflow: hidden auto; border-left: 1px solid #8884; padding: 4px 12px 12px; }
.side h4 { font-size: 12px; text-transform: uppercase; letter-spacing: 0.06em; opacity: 0.7; margin: 9px 0 1px; }
.strip { display: grid; grid-template: minmax(0, 1fr) / repeat(4, minmax(0, 1fr)); gap: 8px; padding: 6px 8px;
  border-top: 1px solid #8884; }
.tile { display: flex; flex-direction: column; min-width: 0; min-height: 0; font-size: 12px; }
.tile img { flex: 1; min-height: 0; object-fit: contain; background: #000; image-rendering: auto; }
.tile svg { flex: 1; min-height: 0; width: 100%; background: #8881; }
.tile .empty { flex: 1; display: flex; align-items: center; justify-content: center; text-align: center;
  background: #8881; padding: 8px; }
.knob { display: grid; grid-template-columns: 1fr 92px; align-items: center; column-gap: 8px; }
.knob label { grid-column: 1 / 3; font-size: 12px; margin-bottom: -4px; }
.row { display: flex; gap: 6px; flex-wrap: wrap; align-items: center; }
.small { font-size: 12px; opacity: 0.8; }
.v-input { font-size: 13px; }
.side .v-field { --v-field-padding-start: 9px; --v-field-padding-end: 4px; }
.knob .v-field__input { padding: 4px 8px; font-size: 13px; min-height: 32px; }
"""
LISTEN = """
window.addEventListener('keydown', (e) => {
  if (e.ctrlKey || e.metaKey || e.altKey || e.target.matches('input, textarea, [role=slider], [role=combobox]')) return;
  if (e.key === ' ' && e.target.matches('button')) return;
  if ([' ', 'ArrowLeft', 'ArrowRight'].includes(e.key)) e.preventDefault();
  window.trame.trigger('key', [e.key]);
});
"""


def build(server: Any, panel: Panel) -> None:
    """Build the page. The state of ``panel`` must already hold its initial values."""
    from trame.ui.vuetify3 import VAppLayout
    from trame.widgets import client, html
    from trame.widgets import vuetify3 as v

    server.trigger("key")(panel.key)
    with VAppLayout(server) as layout:
        layout.root.theme = ("dark ? 'dark' : 'light'",)
        client.Style(STYLE)
        client.Script(LISTEN)
        with html.Div(classes="panel", tabindex="0"):
            _bar(panel, html, v)
            _cloud(server, panel, html, v)
            with html.Div(classes="side"):
                _window(panel, html, v)
                _prism(panel, html, v)
                _calibration(panel, html, v)
                _look(html, v)
                _export(panel, html, v)
            _strip(html)
        _help(html, v)


def _bar(panel: Panel, html: Any, v: Any) -> None:
    with html.Div(classes="bar"):
        html.B("{{ name }}")
        html.Span("{{ events }}", id="events")
        html.Span("sharpness {{ sharpness }}", id="sharpness")
        html.Div(classes="grow")
        with v.VBtnToggle(v_model=("view",), density="compact", mandatory=True, variant="outlined"):
            for view in View:
                v.VBtn(view.value, value=view.value, size="small")
        _button(v, "{{ overlaid ? 'side by side' : 'overlaid' }}", "overlaid = !overlaid", "overlaid")
        _button(v, "{{ dark ? 'light' : 'dark' }}", "dark = !dark", "dark")
        _button(v, "help ?", "help_shown = true", "help")


def _button(v: Any, text: str, action: Any, name: str, **more: Any) -> None:
    v.VBtn(text, click=action, id=f"do-{name}", size="small", variant="tonal", **more)


def _cloud(server: Any, panel: Panel, html: Any, v: Any) -> None:
    from trame.widgets import vtk

    with html.Div(classes="cloud", id="cloud"):
        view = vtk.VtkRemoteView(panel.scene.plotter.render_window, ref="view", interactive_ratio=1,
                                 interactive_quality=70, still_quality=92)  # fmt: skip
        server.controller.view_update = view.update
        hint = "drag: rotate · wheel: zoom · shift + drag: move · click: describe an event and show its orbit (green)"
        html.Div(hint, classes="hint", v_show="!message && !picked")
        with html.Div(classes="said"):
            v.VAlert("{{ picked }}", v_if="picked", density="compact", closable=True, id="picked",
                     click_close="picked = ''")  # fmt: skip
            v.VAlert("{{ message }}", v_if="message", type=("severity",), density="compact", closable=True,
                     id="message", click_close="message = ''")  # fmt: skip


def _window(panel: Panel, html: Any, v: Any) -> None:
    html.H4("window")
    v.VSlider(v_model=("start_ms",), min=0, max=("whole_ms",), step=0.1, hide_details=True, density="compact",
              id="start", update_modelValue="playing = false", end=(panel.slider_released,))  # fmt: skip
    with html.Div(classes="row"):
        _number(panel, v, "start_ms", "from [ms]", 102)
        _number(panel, v, "length_ms", "length [ms]", 102)
        turns = "turn_ms ? Number((length_ms / turn_ms).toFixed(3)) : ''"
        _number(panel, v, "turns", "turns", 76, shown=turns, disabled=("!turn_ms",))
    with html.Div(classes="row", style="margin-top: 6px"):
        _button(v, "◀ turn", (panel.step, "[-1]"), "back", disabled=("!turn_ms",))
        _button(v, "{{ playing ? 'stop' : live ? 'follow' : 'play' }}", panel.play, "play")
        _button(v, "turn ▶", (panel.step, "[1]"), "step", disabled=("!turn_ms",))
        v.VSelect(v_model=("speed",), items=(str(list(SPEEDS)),), density="compact", hide_details=True,
                  style="max-width: 100px; min-width: 100px", label="speed ×", v_show="!live")  # fmt: skip
    with html.Div(classes="row"):
        with v.VBtnToggle(v_model=("polarity",), density="compact", mandatory=True, variant="outlined", id="polarity"):
            for name in ("both", "ON", "OFF"):
                v.VBtn(name, value=name, size="x-small")
        v.VCheckbox(v_model=("hide_hot",), label="hide hot pixels", density="compact", hide_details=True, id="hot")
    for axis, k in (("x", 0), ("y", 1)):
        with html.Div(style="display: grid; grid-template-columns: 84px 1fr; align-items: center"):
            html.Span(f"{axis} {{{{ region_{axis}[0] }}}} to {{{{ region_{axis}[1] }}}}", classes="small")
            v.VRangeSlider(v_model=(f"region_{axis}",), min=0, max=(f"size[{k}]",), step=1, strict=True,
                           density="compact", hide_details=True, end=(panel.slider_released,))  # fmt: skip


def _number(panel: Panel, v: Any, name: str, label: str, width: int, *, shown: str = "", **more: Any) -> None:
    """Add a number field for the state variable ``name``; ``shown`` is an expression to show instead of it."""
    v.VTextField(model_value=(shown or name,), change=(panel.typed, f"['{name}', $event.target.value]"), type="number",
                 label=label, density="compact", hide_details=True, style=f"max-width: {width}px",
                 id=f"field-{name}", **more)  # fmt: skip


def _prism(panel: Panel, html: Any, v: Any) -> None:
    html.H4("prism")
    v.VSelect(v_model=("model",), items=(str(list(MODELS)),), label="model", density="compact", hide_details=True,
              style="margin: 4px 0", id="model")  # fmt: skip
    for name, label, unit, (least, most, step), where in SLIDERS:
        with html.Div(classes="knob", **({} if where is None else {"v_if": where})):
            html.Label(f"{label} [{unit}]")
            v.VSlider(v_model=(name,), min=(least,), max=(most,), step=step, hide_details=True, density="compact",
                      id=f"slider-{name}", start=(panel.select_curve, f"['{name}']"), end=(panel.slider_released,),
                      focus=(panel.select_curve, f"['{name}']"))  # fmt: skip
            _number(panel, v, name, "", 92)


def _calibration(panel: Panel, html: Any, v: Any) -> None:
    html.H4("calibration")
    with html.Div(classes="row"):
        calibrating = "busy.startsWith('calibrating')"
        _button(v, f"{{{{ {calibrating} ? 'cancel' : 'calibrate' }}}}", panel.calibrate, "calibrate",
                color="primary", disabled=(f"!!busy && !{calibrating}",))  # fmt: skip
        _button(v, "save", panel.save, "save")
    with html.Div(v_if="busy", style="margin-top: 4px"):
        html.Span("{{ busy }}", classes="small")
        v.VProgressLinear(model_value=("progress",), height=6)
    with html.Div(v_if="found", id="found", style="margin-top: 4px"):
        html.Div("found: {{ found }}", classes="small")
        with html.Div(classes="row"):
            _button(v, "accept", panel.accept, "accept", color="primary")
            _button(v, "discard", panel.discard, "discard")


def _look(html: Any, v: Any) -> None:
    html.H4("points")
    with html.Div(classes="row"):
        axes = str([each.value for each in Axis])
        for name, label, items in (("colour", "colour", "colours"), ("axis", "third axis", axes)):
            v.VSelect(v_model=(name,), items=(items,), label=label, density="compact", hide_details=True,
                      style="max-width: 140px", id=name)  # fmt: skip
    for name, label, most, step in (("point_size", "size", 8, 0.5), ("opacity", "opacity", 1, 0.05)):
        with html.Div(style="display: grid; grid-template-columns: 84px 1fr; align-items: center"):
            html.Span(label, classes="small")
            v.VSlider(v_model=(name,), min=step, max=most, step=step, hide_details=True, density="compact")
    v.VCheckbox(v_model=("orbit_shown",), label="show the model's orbit", density="compact", hide_details=True)
    html.Div("ground truth: {{ truth }}", v_if="truth", classes="small", id="truth")


def _export(panel: Panel, html: Any, v: Any) -> None:
    html.H4("export")
    v.VTextField(v_model=("out",), label="file name (default: recording's name)", density="compact",
                 hide_details=True, maxlength=120, style="margin: 4px 0", id="out")  # fmt: skip
    with html.Div(classes="row"):
        _button(v, "picture", panel.save_picture, "picture")
        _button(v, "turntable", panel.playback.turntable, "turntable", disabled=("!!busy",))
        _button(v, "film from here", panel.playback.film, "film", disabled=("!!busy",))


def _strip(html: Any) -> None:
    with html.Div(classes="strip"):
        for name, title in (("before", "events as recorded"), ("after", "events compensated")):
            with html.Div(classes="tile"):
                html.Span(title)
                html.Img(src=(name,), id=f"image-{name}")
        with html.Div(classes="tile"):
            html.Span("log intensity {{ picture_note && picture ? '(' + picture_note + ')' : '' }}")
            html.Img(src=("picture",), v_if="picture", id="image-picture")
            html.Div("{{ picture_note || 'computed when a slider is released' }}", v_else=True, classes="empty")
        with html.Div(classes="tile"):
            html.Span("sharpness over {{ knob }}")
            _plot(html, "curve", "<line :x1='curve_mark' :x2='curve_mark' y1='0' y2='40' stroke='#d55e00' "
                  "vector-effect='non-scaling-stroke'/>")  # fmt: skip
            html.Span("{{ curve_text || 'computed when a slider is released' }}", id="curve-text")
            html.Span("event rate, maximum {{ rate_top }}")
            _plot(html, "rate", "<rect :x='100 * shown_from' :width='Math.max(100 * shown_part, 0.4)' y='0' "
                  "height='40' fill='#0072b2' fill-opacity='0.35'/>")  # fmt: skip


def _plot(html: Any, name: str, mark: str) -> None:
    html.Div(
        f"<svg viewBox='0 0 100 40' preserveAspectRatio='none' style='width: 100%; height: 100%'>{mark}"
        f"<polyline :points='{name}' fill='none' stroke='currentColor' vector-effect='non-scaling-stroke'/></svg>",
        style="flex: 1; min-height: 0", id=f"plot-{name}",
    )  # fmt: skip


def _help(html: Any, v: Any) -> None:
    with v.VDialog(v_model=("help_shown",), max_width=560), v.VCard(title="Keys", id="help"), v.VCardText():
        with html.Table(style="font-size: 14px"):
            for key, _, words in KEYS:
                with html.Tr():
                    html.Td({" ": "space"}.get(key, key), style="padding-right: 24px; font-weight: 600")
                    html.Td(words)
        html.P(
            "Left: events as recorded. Right: events after motion compensation with the current parameters. Drag apex "
            "and phase until the right cloud forms straight columns and the sharpness is highest, or press calibrate. "
            "The green line is the orbit on which the model sees one scene point; with the correct parameters it "
            "follows the cloud.",
            style="margin-top: 12px",
        )
