"""Options are made from the signatures of verbs, and messages that name arguments of Python name the options."""

import inspect
from pathlib import Path

import pytest
from commands import leave, refused

from covariant import many, verbs
from covariant.cli._app import REMOVED
from covariant.cli._commands import COMMANDS
from covariant.cli._options import COLUMNS, in_options
from covariant.cli._signature import REQUIRED, function, signature

FLAGS = {"alpha": "--alpha", "start": "--from", "overwrite": "--overwrite", "parameters": "--parameters"}
FLAGS |= {'columns["q"]': "--q", 'columns["t"]': "--t", "overrides": "--set", "lag": "--lag"}


@pytest.mark.parametrize("verb", [command.verb for command in COMMANDS] + ["check_certificate"])
def test_a_signature_that_is_read_from_source_is_that_of_the_function(verb):
    read = signature(verb)
    parameters = dict(inspect.signature(function(verb)).parameters)
    assert read.progress == (parameters.pop("progress", None) is not None)
    assert [*read.arguments] == [*parameters]
    for name, argument in read.arguments.items():
        default = parameters[name].default
        assert argument.default == (REQUIRED if default is inspect.Parameter.empty else default)
        assert argument.text.endswith((".", "…"))


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.verb)
def test_each_argument_has_one_option_and_each_option_a_help(command):
    options = command.options
    names = [option.name for option in options]
    assert len(names) == len({*names})
    assert {*signature(command.verb).arguments} - {*names} <= {"columns"}
    assert all(option.help for option in options)
    assert ("columns" in signature(command.verb).arguments) == ({"t", "q", "u"} <= {*names})


def test_every_verb_has_a_command():
    names = {name for name in {*dir(verbs), *dir(many)} if name.islower() and not name.startswith("check_")}
    assert names - {"columns_of", "over_logs"} == {command.verb for command in COMMANDS}
    assert set(COLUMNS) == {"t", "q", "u", "v", "truth"}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("`alpha` must be positive", "--alpha must be positive"),
        ("use `start=2`, or say `overwrite=True`", "use --from 2, or say --overwrite"),
        ("none by `parameters=[]`", "none by --parameters none"),
        ('name them by `columns["q"]`', "name them by --q"),
        ("by `overrides`", "by --set"),
        ("give `overrides=['a.b=1', 'c=[\"d\"]']`", "give --set a.b=1 --set 'c=[\"d\"]'"),
        ("alpha and `beta`, and `covariant check m.toml`", "alpha and `beta`, and `covariant check m.toml`"),
    ],
)
def test_arguments_in_a_message_become_options(text, expected):
    assert in_options(text, FLAGS) == expected


MISSING = "`overrides=['measurement.std=NUMBER', 'uncertainty.acceleration=NUMBER']`"


@pytest.mark.parametrize(
    ("call", "named", "options", "message"),
    [
        ("estimate oscillator log.csv", {"alpha": 1.0}, "--alpha 1", "`alpha` and `beta` belong together"),
        ("smooth oscillator log.csv", {"lag": -1.0}, "--lag -1", "`lag` must be a time"),
        ("init log.csv", {"columns": {"q": "q1"}}, "--q q1 -o model.toml", 'of the stamps by `columns["t"]`'),
        ("estimate oscillator log.csv", {"columns": {"t": "a", "q": "q1", "u": "b"}}, "--t a --q q1 --u b", MISSING),
    ],
)
def test_a_function_and_its_command_say_what_to_give_each_in_its_words(
    tmp_path, monkeypatch, call, named, options, message
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.csv").write_text("a,b,q1\n0,0,0.1\n1,1,0\n2,2,0.1\n")
    verb, *arguments = call.split()
    with pytest.raises(ValueError) as refusal:  # noqa: PT011  the text is compared below
        function(verb)(*arguments, **named)
    assert message in str(refusal.value)
    assert "--" not in str(refusal.value)
    refused(*call.split(), *options.split(), named=[in_options(message, FLAGS | {"beta": "--beta"})])


@pytest.mark.core(2)
@pytest.mark.parametrize("name", REMOVED)
@pytest.mark.parametrize("words", ["", " 64k", "=64k"])
def test_what_is_gone_names_what_replaces_it(name, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    message = refused(*f"{name}{words if '--' in name else ' model.toml'}".split())
    assert message == f"covariant: `{name}` is gone: {REMOVED[name]}\n"


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.verb)
def test_the_example_in_the_help_has_options_of_its_command_and_its_page_is_there(command):
    words = command.example.split()
    assert command.example.startswith(command.name or command.verb)
    flags = {flag for option in command.options for flag in option.flags}
    assert {word for word in words if word.startswith("-")} <= flags
    assert (Path(__file__).parents[2] / command.page).is_file()


def test_the_help_cuts_no_line_and_puts_the_log_first():
    shown = leave("--help").out
    assert "…" not in shown
    assert "..." not in shown.partition("Your log:")[2]
    assert shown.index("Your log:") < shown.index("  init ") < shown.index("  estimate ") < shown.index("Proofs")
    assert "Example:  covariant check arm.toml log.csv\n" in leave("check", "--help").out
