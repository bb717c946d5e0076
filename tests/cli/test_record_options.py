"""Options that are made of the fields of a dataclass."""

from dataclasses import dataclass, fields
from typing import Any, get_type_hints

import typer
from typer.testing import CliRunner

import amiwarp
from amiwarp.cli.common import command
from amiwarp.cli.record_options import with_options_of
from amiwarp.schema.field_texts import field_texts
from amiwarp.simulation.commands.rig_options import EncoderModelOptions, SensorOptions


@dataclass(frozen=True)
class Record:
    """Record with texts."""

    rate_hz: float = 5.0
    """Rate of the
    samples [1/s].

    More about it.
    """
    count: int | None = 3
    """Number of samples; None for ``all``."""
    bare: float = 1.0
    hidden: float = 2.0
    """Not an option."""


@with_options_of(Record, typer.Option, leave_out=("hidden",))
@dataclass(frozen=True)
class Options:
    """Options of the record."""

    own: bool = False

    def given(self) -> dict[str, Any]:
        """Return the options that are given."""
        return {name: value for name, value in vars(self).items() if value is not None}


def test_the_texts_of_fields() -> None:
    assert field_texts(Record) == {
        "rate_hz": "Rate of the samples [1/s].",
        "count": "Number of samples; None for ``all``.",
        "hidden": "Not an option.",
    }
    assert field_texts(type("Made", (), {})) == {}


def test_options_have_the_names_types_and_texts_of_the_fields() -> None:
    assert [field.name for field in fields(Options)] == ["own", "rate_hz", "count", "bare"]
    found: list[Any] = []
    app = typer.Typer()

    def run_it(*, options: Options) -> None:
        """Run."""
        found.append(options.given())

    run_it.__annotations__["options"] = Options
    command(app, run_it, name="it", example="it")
    runner = CliRunner()
    assert runner.invoke(app, ["--rate-hz", "2", "--count", "7", "--own"]).exit_code == 0
    assert runner.invoke(app, []).exit_code == 0
    assert found == [{"own": True, "rate_hz": 2.0, "count": 7}, {"own": False}]
    assert isinstance(found[0]["count"], int)
    for words in (["--count", "1.5"], ["--hidden", "1"]):
        assert runner.invoke(app, words).exit_code == 2
    shown = " ".join(runner.invoke(app, ["--help"], env={"COLUMNS": "200"}).stdout.split())
    for text in (
        "Rate of the samples (1/s).",
        "Number of samples; None for all.",
        "Field bare of amiwarp.Record.",
    ):
        assert text in shown
    assert "More about it" not in shown


def test_the_simulation_has_an_option_for_each_field_of_its_models() -> None:
    sensor = {field.name for field in fields(amiwarp.SensorModel)}
    assert {field.name for field in fields(SensorOptions)} == sensor | {"ideal", "sensor"}
    assert SensorOptions().build() == amiwarp.SensorModel()
    assert SensorOptions(ideal=True, leak_hz=2.0).build().leak_hz == 2.0  # type: ignore[call-arg]
    encoder = {field.name for field in fields(amiwarp.EncoderModel)} - {"harmonics"}
    assert {field.name for field in fields(EncoderModelOptions)} == encoder | {"encoder_error_deg"}
    own = get_type_hints(EncoderModelOptions, include_extras=True)["counts_per_turn"]
    assert "0: no rounding" in own.__metadata__[0].help
    made = EncoderModelOptions(counts_per_turn=0, dropout_us=3.0).build()  # type: ignore[call-arg]
    assert (made.counts_per_turn, made.dropout_us) == (None, 3.0)
    for model in (amiwarp.SensorModel, amiwarp.EncoderModel):
        assert field_texts(model).keys() == {field.name for field in fields(model)}
