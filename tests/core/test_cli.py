"""The `deepshade` command: lists everything, loads lazily, fails in words."""

import subprocess
import sys
from importlib.metadata import EntryPoint, version
from pathlib import Path

import pytest
from rich.text import Text

from deepshade import cli
from deepshade.errors import DeepshadeError


def point(name, value):
    return EntryPoint(name=name, value=value, group=cli.GROUP)


@pytest.fixture
def commands(monkeypatch):
    """Subcommands of this module instead of the installed ones."""

    def install(**functions):
        module = sys.modules[__name__]
        points = []
        for name, function in functions.items():
            monkeypatch.setattr(module, f"command_{name}", function, raising=False)
            points.append(point(name, f"{__name__}:command_{name}"))
        monkeypatch.setattr(cli, "entry_points", lambda group: points)

    return install


def where():
    """How advice names this clone."""
    clone = Path(__file__).resolve().parents[2]
    return "." if clone == Path.cwd() else clone


@pytest.mark.parametrize("arguments", [["--version"], ["serve", "--version"]])
def test_version(arguments, capsys):
    assert cli.main(arguments) == 0
    assert capsys.readouterr().out.strip() == f"deepshade {version('deepshade')}"


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("deepshade doc", "doctor"),
        ("deepshade inspect --prof", "--profile"),
        ("deepshade serve --log-level w", "warning"),
    ],
)
def test_shells_complete_commands_options_and_values(words, offered, monkeypatch, capsys):
    monkeypatch.setenv("_DEEPSHADE_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
    with pytest.raises(SystemExit):
        cli.main([])
    assert capsys.readouterr().out.split() == [offered]


def test_every_help_has_an_example(capsys):
    group = cli.application()
    for name in group.list_commands(None):
        assert f"deepshade {name} " in group.get_command(None, name).help, name


def test_no_part_of_a_help_is_taken_for_markup():
    group = cli.application()
    for name in group.list_commands(None):
        command = group.get_command(None, name)
        for text in filter(None, (command.help, *(p.help for p in command.params))):
            assert Text.from_markup(text).plain == text, name


def test_help_lists_every_installed_command(capsys):
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    for name in ("inspect", "doctor", "render", "datagen", "train", "evaluate", "export", "serve"):
        assert name in text


def test_deepshade_errors_are_two_lines(commands, capsys):
    def broken() -> None:
        raise DeepshadeError("it broke", fix="mend it")

    commands(broken=broken)
    assert cli.main(["broken"]) == 2
    assert capsys.readouterr().err == "error: it broke\n  fix: mend it\n"


def test_a_missing_extra_is_named(commands, capsys):
    def heavy() -> None:
        raise ModuleNotFoundError("No module named 'torch'", name="torch")

    commands(heavy=heavy)
    assert cli.main(["heavy"]) == 2
    assert f"pip install -e '{where()}[trainer]'" in capsys.readouterr().err


def test_other_missing_modules_are_bugs(commands):
    def bug() -> None:
        raise ModuleNotFoundError("No module named 'nonsense'", name="nonsense")

    commands(bug=bug)
    with pytest.raises(ModuleNotFoundError):
        cli.main(["bug"])


def test_interrupts_and_exit_codes(commands):
    def interrupted() -> None:
        raise KeyboardInterrupt

    def three() -> None:
        import typer

        raise typer.Exit(3)

    commands(interrupted=interrupted, three=three)
    assert cli.main(["interrupted"]) == 130
    assert cli.main(["three"]) == 3


def test_a_path_that_cannot_be_written_is_no_traceback(commands, capsys):
    def write() -> None:
        open("/proc/nowhere/x.exr", "w")  # noqa: PTH123, SIM115

    commands(write=write)
    assert cli.main(["write"]) == 2
    assert capsys.readouterr().err == "error: /proc/nowhere/x.exr: No such file or directory\n"


def test_usage_errors(capsys):
    assert cli.main(["insepct"]) == 2
    assert "Did you mean 'inspect'?" in capsys.readouterr().err
    assert cli.main(["inspect"]) == 2
    assert cli.main(["inspect", "--nonsense"]) == 2


def test_a_command_whose_module_is_absent_says_so(monkeypatch, capsys):
    monkeypatch.setattr(cli, "entry_points", lambda group: [point("gone", "torchless.cli:run")])
    assert cli.main(["--help"]) == 0
    assert "not available" in capsys.readouterr().out


def test_listing_commands_imports_nothing_heavy():
    code = (
        "import sys; from deepshade.cli import main; main(['--help']); "
        "print(sorted({'torch', 'mitsuba', 'ray', 'onnxruntime', 'fastapi'} & set(sys.modules)))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert result.stdout.strip().splitlines()[-1] == "[]"
