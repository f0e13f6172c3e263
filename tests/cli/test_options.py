"""Options of commands: every one has a help text, that of the docstring of its dataclass."""

import inspect

import pytest

from invertwin.cli import options

KINDS = (
    "OutputOptions",
    "RunOptions",
    "DatasetOptions",
    "FitOptions",
    "LookOptions",
    "TwinOptions",
)


def infos(kind):
    command = options.with_options(kind)(lambda given: None)
    parameters = inspect.signature(command).parameters.items()
    return {name: parameter.annotation.__metadata__[0] for name, parameter in parameters}


def test_the_help_is_the_text_of_the_docstring():
    found = infos(options.LookOptions)
    assert found["config"].help == "Settings of a .bin: .cfg or .mmwave.json."
    assert found["recording"].help.endswith("an .s1p or .s2p sweep, or a .nc capture.")
    # An option that several commands share brings its own.
    assert infos(options.FitOptions)["engine"].help.startswith("Processes of this machine")


def test_commands_with_one_option_of_two_meanings_keep_them_apart():
    assert infos(options.RunOptions)["seed"].help == "Replaces the run file's seed."
    assert infos(options.TwinOptions)["seed"].help == "Of rays; default: 0."
    assert infos(options.RunOptions)["seed"].max == 2**31 - 1


@pytest.mark.parametrize("name", KINDS)
def test_no_option_is_without_help(name):
    silent = [option for option, info in infos(getattr(options, name)).items() if not info.help]
    assert silent == []
