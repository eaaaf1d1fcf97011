"""The ``neuprim`` command: parse, call, print.

Exit status: 0 done, 1 no backend works (``doctor``), 2 the input's fault (one line on standard error), 130 interrupted.
A bug in neuprim keeps its traceback. Heavy modules are imported by the subcommands that need them, so that help stays
fast.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from neuprim.cli import arguments
from neuprim.cli.environment_flags import add_environment_flags, environment_of
from neuprim.cli.export_help import export_help
from neuprim.cli.metrics_report import print_metrics
from neuprim.cli.operating_words import DRAWN, OPERATING, operating_words
from neuprim.cli.prune import for_prune, prune
from neuprim.cli.run_help import COMMON_KEYS, EXAMPLES
from neuprim.cli.tradeoff import FORMS, for_tradeoff, of_words, tradeoff
from neuprim.cli.truth import TRUTH_HELP, for_truth, truth
from neuprim.cli.view import for_view, view
from neuprim.core.errors import ConfigError, NeuprimError, nearest, one_line
from neuprim.core.io.trust import trusting
from neuprim.core.notices import warnings_as_lines
from neuprim.version import __version__

if TYPE_CHECKING:
    from neuprim.core.task import TaskSpec

__all__ = ["main"]


class Parser(argparse.ArgumentParser):
    """Reports a wrong command line as one line."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message} (see {self.prog} --help)")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit status."""
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        with warnings_as_lines():
            return _dispatch(words)
    except KeyboardInterrupt as stop:
        print(f"neuprim: interrupted{stop}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # `neuprim tasks | head`; the interpreter's own flush at exit must not fail either
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (NeuprimError, OSError, RuntimeError) as error:
        line = one_line(error)
        if line is None:
            raise
        print(f"neuprim: error: {line}", file=sys.stderr)
        return 2
    except SystemExit as stop:  # argparse, after --help and --version
        return stop.code if isinstance(stop.code, int) else 0


def _dispatch(words: list[str]) -> int:
    parser, commands = _parsers(with_tasks=words[:1] == ["run"], asked=words[1:] if words[:1] == ["export"] else ())
    if not words:
        parser.print_help()
        return 0
    if not words[0].startswith("-") and words[0] not in commands:
        raise ConfigError(f"{words[0]}: no such command{nearest(words[0], commands)}")
    args, rest = parser.parse_known_args(words)
    if args.command in ("run", "truth", "bench"):
        args.overrides += [word for word in rest if not word.startswith("-")]  # argparse gives up on words after a flag
        rest = [word for word in rest if word.startswith("-")]
    if args.command == "tradeoff" and of_words(args.run_dir):
        args.words, rest = (
            [word for word in rest if not word.startswith("-")],
            [word for word in rest if word.startswith("-") and word != "--"],
        )
    elif args.command in DRAWN:
        args.words, rest = operating_words(rest)
    if args.command in ("render", "inspect"):
        args.conditions, rest = _conditions(args.run_dir, rest, args.command, commands[args.command])
    if args.command == "export":
        args.options, rest = _export_words(args.run_dir, rest, commands[args.command]), []
    if rest:
        known = [flag for flag in commands[args.command]._option_string_actions if flag.startswith("--")]
        raise ConfigError(f"{rest[0]}: no such argument of `neuprim {args.command}`{nearest(rest[0], known)}")
    with trusting(getattr(args, "trust", False)):
        return int(args.call(args))


def _parsers(with_tasks: bool, asked: Sequence[str] = ()) -> tuple[Parser, dict[str, argparse.ArgumentParser]]:
    parser = Parser(
        prog="neuprim", description="Radiance fields made of splattable neural primitives.", allow_abbrev=False
    )
    parser.add_argument("--version", action="version", version=f"neuprim {__version__}")
    sub = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)

    def command(
        name: str, call: Callable[[argparse.Namespace], int], summary: str, epilog: str = ""
    ) -> argparse.ArgumentParser:
        raw = argparse.RawDescriptionHelpFormatter
        made = sub.add_parser(
            name, help=summary, description=summary, epilog=epilog, formatter_class=raw, allow_abbrev=False
        )
        made.set_defaults(call=call)
        arguments.for_stored(made, name)
        return made

    run = command(
        "run", _run, "fit a scene", "\n\n".join([COMMON_KEYS, *([_task_names()] if with_tasks else []), EXAMPLES])
    )
    run.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="settings, in Hydra's grammar")
    run.add_argument(
        "-m", "--multirun", action="store_true", help="run every combination of values separated by commas"
    )
    run.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="start with the settings of RUN_DIR/config.yaml; words beside it come first",
    )
    run.add_argument("--cfg", action="store_true", help="print the resolved configuration and stop")

    for_truth(command("truth", truth, "render the ground truth of a scene before runs need it", TRUTH_HELP))

    evaluate = command("eval", _eval, "measure a run on its test views", OPERATING)
    evaluate.add_argument("run_dir", type=Path, metavar="RUN_DIR")
    evaluate.add_argument(
        "--lpips", type=Path, metavar="FILE", help="measure LPIPS with these weights of your own, a file or a folder"
    )

    render = command(
        "render",
        _render,
        "draw images of a run",
        "Each condition of the run's task (time, light, ...) is a flag, given after RUN_DIR: --time 0.5; a number may also be a list or a "
        "range, --time 0.2,0.8 or --time 0:1:20, one frame each.\n\n" + OPERATING,
    )
    arguments.for_render(render)
    add_environment_flags(render)

    trade = command(
        "tradeoff",
        _tradeoff,
        "measure what speed and size cost in accuracy: how a run is drawn, or what is trained",
        FORMS + OPERATING,
    )
    trade.usage = "neuprim tradeoff RUN_DIR | KEY=VALUE ... [KEY=VALUE ...] [--views N] [--repeats N] [--knobs NAME ...] [--budget TIME] [--seeds N] [--lpips FILE]"
    for_tradeoff(trade)

    export = command("export", _export, "write a run's model in another format", export_help(asked))
    export.usage = (
        "neuprim export RUN_DIR --format NAME [KEY=VALUE ...] [--CONDITION TEXT ...] [--out PATH] [--force] [--json]"
    )
    export.add_argument("run_dir", type=Path, metavar="RUN_DIR")
    export.add_argument(
        "--format",
        required=True,
        metavar="NAME",
        help="which format; all of them, those of plugins too, are listed below",
    )
    export.add_argument("--out", type=Path, metavar="PATH", help="where to write (default: in RUN_DIR/export)")
    export.add_argument("--force", action="store_true", help="replace files that exist")
    export.add_argument("--json", action="store_true", help="print JSON")

    arguments.for_compress(
        command("compress", _compress, "write a run's model in few bits, as one file that every command reads")
    )

    for_prune(command("prune", _prune, "remove what a run's scene does not require, and write the rest as a run"))

    back = command("import", _import, "make a run directory of an exported .ply or .npz, or of a .neuprim")
    back.add_argument("file", type=Path, metavar="FILE")
    back.add_argument("--out", type=Path, required=True, metavar="RUN_DIR", help="new directory")

    inspect = command(
        "inspect",
        _inspect,
        "look inside a run's density",
        "Each condition of the run's task is a flag, given after RUN_DIR: --time 0.5, or several frames: --time 0:1:20, --time 0.2,0.8.",
    )
    arguments.for_inspect(inspect)

    for_view(
        command("view", _view, "look at a run in the browser: turn it, play it, move its light, edit a camera path")
    )

    vdb = command(
        "vdb",
        _vdb,
        "look into OpenVDB files",
        "`info` lists grids: type, transform, bounds, active voxels, values, memory.",
    )
    vdb.add_argument("action", choices=("info",), metavar="info", help="what to do")
    vdb.add_argument("path", type=Path, metavar="FILE|DIR", help="a .vdb file, or a folder of frames")
    vdb.add_argument("--json", action="store_true", help="print JSON")

    command("tasks", _tasks, "list tasks, scenes, presets and other plugins, and the packages they come from")

    new = command("new-task", _new_task, "write a small working package with a task of your own: see docs/plugins.md")
    new.add_argument("name", metavar="NAME", help="what users will type after task=: lower-case letters, digits and _")
    new.add_argument("--out", type=Path, metavar="DIR", help="a folder that does not exist yet (default: neuprim-NAME)")

    bench = command("bench", _bench, "the paper's tables, and runs of their protocol on data that you have")
    arguments.for_bench(bench)

    command("doctor", _doctor, "show versions, devices and which renderer backends work here")
    return parser, dict(sub.choices)


# ---------------------------------------------------------------- commands


def _run(args: argparse.Namespace) -> int:
    from neuprim.config import compose, compose_all, stored_config
    from neuprim.config.launcher import LauncherSettings, launcher_words
    from neuprim.config.overrides import Typed, without_place
    from neuprim.config.target import target_words
    from neuprim.config.viewer import viewer_words
    from neuprim.core.train.distributed.place import place_of
    from neuprim.runs.chunks.asked import asked, refuse_chunks

    place = place_of()
    if place is not None:
        from neuprim.cli.ranks import run_as_rank

        return run_as_rank(place, args.overrides, args.multirun or args.cfg or args.config is not None)
    check, typed = not args.cfg, Typed(args.overrides, args.config)
    viewer, words = viewer_words(args.overrides)
    launcher, words = launcher_words(words)
    wanted, words = target_words(words)
    elsewhere = launcher != LauncherSettings()
    beside = {"-m": args.multirun, "target": wanted is not None, "launcher": elsewhere}
    if viewer is not None and any(beside.values()):
        raise ConfigError(
            f"viewer=true: shows one run; expected no {next(word for word, on in beside.items() if on)} beside it"
        )
    if wanted is not None and args.multirun:
        raise ConfigError(f"{wanted[0]}: a target is for one run; expected no -m beside it")
    if args.multirun and not without_place(words):
        from neuprim.runs.sweep.record import begun_words

        words = begun_words(words)
        typed = Typed([*words, *args.overrides], args.config)  # what goes on with it says all of it
    stored = None if args.config is None else stored_config(args.config)
    configs = compose_all(words, check, stored) if args.multirun else [compose(words, check, stored)]
    if args.cfg:
        if wanted is not None:
            print(f"# {wanted[0]} budget={wanted[1]:g}s; the search starts from")
        print("---\n".join(config.to_yaml() for config in configs), end="")
        return 0
    if wanted is not None:
        from neuprim.cli.target import fit_target

        return fit_target(configs[0], *wanted, launcher, typed)
    if len(configs) > 1:
        from neuprim.cli.sweep import sweep

        return sweep(configs, words, launcher, typed)
    if viewer is not None:
        refuse_chunks(configs[0], "viewer=true shows one training")
    if elsewhere and not asked(configs[0]):  # of a run in chunks these are what works elsewhere
        from neuprim.cli.sweep import launch_one

        return launch_one(configs[0], launcher, typed)
    from neuprim.cli.one_run import one_run

    print(one_run(configs[0], typed, viewer, launcher))
    return 0


def _eval(args: argparse.Namespace) -> int:
    run_dir = _run_directory(args.run_dir)
    from neuprim.runs.measure import evaluate_run

    print_metrics(evaluate_run(run_dir, args.lpips, args.words))
    return 0


def _render(args: argparse.Namespace) -> int:
    run_dir = _run_directory(args.run_dir)
    if args.camera not in ("orbit", "test") and not any(
        Path(name).exists() for name in (args.camera, args.camera.partition("#")[0])
    ):
        raise ConfigError(f"--camera {args.camera}: no such file; expected orbit, test, or a file or folder of cameras")
    environment = environment_of(args)
    from neuprim.cli.console import plain_console
    from neuprim.cli.progress import DrawProgress
    from neuprim.runs.draw import render_run

    given = {"space": args.space, "layers": args.layers, "datatype": args.datatype, "overwrite": args.force or None}
    more: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    with DrawProgress(plain_console(stderr=True)) as progress:
        paths = render_run(
            *(run_dir, args.camera, args.size, args.format, args.out, args.frames, args.conditions, args.fps),
            environment=environment,
            tell=progress.note,
            progress=progress.show,
            words=args.words,
            **more,
        )
    for path in paths:
        print(path)
    return 0


def _tradeoff(args: argparse.Namespace) -> int:
    if of_words(args.run_dir):
        from neuprim.cli.tradeoff_models import tradeoff_models

        return tradeoff_models(args)
    args.run_dir = _run_directory(Path(args.run_dir))
    return tradeoff(args)


def _export(args: argparse.Namespace) -> int:
    run_dir = _run_directory(args.run_dir)
    from neuprim.cli.console import plain_console
    from neuprim.cli.export_report import print_report
    from neuprim.cli.progress import LineProgress
    from neuprim.runs.export import export_run

    print_report(
        export_run(run_dir, args.format, args.out, args.options, args.force, LineProgress(plain_console(stderr=True))),
        args.json,
    )
    return 0


def _compress(args: argparse.Namespace) -> int:
    run_dir = _run_directory(args.run_dir)
    from neuprim.cli.compress_report import compress

    return compress(args, run_dir)


def _prune(args: argparse.Namespace) -> int:
    _run_directory(args.run_dir)
    return prune(args)


def _import(args: argparse.Namespace) -> int:
    from neuprim.runs.export import import_run

    print(import_run(args.file, args.out))
    return 0


def _inspect(args: argparse.Namespace) -> int:
    run_dir = _run_directory(args.run_dir)
    from neuprim.cli.progress import print_notes
    from neuprim.inspect import ViewOptions, corners
    from neuprim.runs.inspect import Request, inspect_run

    names = [name.strip() for name in args.show.split(",") if name.strip()]
    names += ["primitives"] * args.primitives + ["primitive"] * (args.primitive is not None)
    options, box = ViewOptions(tuple(args.level), args.primitive), None if args.box is None else corners(args.box)
    more = {
        "options": options,
        "against": args.against,
        "out": args.out,
        "size": args.size,
        "up": args.up,
        "overwrite": args.force,
    }
    for path in inspect_run(
        Request(run_dir, names or ["volume"], args.conditions, args.grid, box, **more), print_notes
    ):
        print(path)
    return 0


def _view(args: argparse.Namespace) -> int:
    _run_directory(args.run_dir)
    return view(args)


def _vdb(args: argparse.Namespace) -> int:
    from neuprim.cli.vdb_info import vdb_info

    return vdb_info(args.path, args.json)


def _tasks(args: argparse.Namespace) -> int:
    from neuprim.cli.listing import list_plugins

    print(*list_plugins(), sep="\n")
    return 0


def _new_task(args: argparse.Namespace) -> int:
    from neuprim.plugins.new_task import new_task

    print(*new_task(args.name, args.out), sep="\n")
    return 0


def _bench(args: argparse.Namespace) -> int:
    from neuprim.cli.bench import bench
    from neuprim.cli.one_run import one_run

    return bench(args, one_run)


def _doctor(args: argparse.Namespace) -> int:
    from neuprim.cli.doctor import doctor

    return doctor()


# ---------------------------------------------------------------- arguments


def _conditions(
    run_dir: Path, words: list[str], command: str, known: argparse.ArgumentParser
) -> tuple[dict[str, str], list[str]]:
    """Condition name -> text, from the flags that the run's task defines, and the words that are none of them."""
    if not words:
        return {}, []
    from neuprim.core.conditions import split_words

    task = _task_of(run_dir)
    found, rest = split_words(words, task.conditions)
    if rest:
        raise _no_such(rest[0], command, known, task)
    return found, []


def _export_words(run_dir: Path, words: list[str], known: argparse.ArgumentParser) -> list[str]:
    """The options and conditions of ``neuprim export``; refuses flags that are neither its own nor conditions."""
    if any(word.startswith("-") for word in words):
        from neuprim.core.conditions import split_words

        task = _task_of(run_dir)
        _, rest = split_words(words, task.conditions, bare=False)
        for word in rest:
            if word.startswith("-"):
                raise _no_such(word, "export", known, task)
    return words


def _task_of(run_dir: Path) -> TaskSpec:
    from neuprim.config import RunConfig, task_of

    file = _run_directory(run_dir) / "config.yaml"
    return task_of(RunConfig.from_yaml(file), file)


def _no_such(word: str, command: str, known: argparse.ArgumentParser, task: TaskSpec) -> ConfigError:
    from neuprim.core.conditions import flag

    flags = [
        f for f in (*known._option_string_actions, *(flag(spec.name) for spec in task.conditions)) if f.startswith("--")
    ]
    return ConfigError(f"{word}: no such argument of `neuprim {command}` for task {task.name!r}{nearest(word, flags)}")


def _run_directory(path: Path) -> Path:
    if not path.is_dir():
        hint = f"; `neuprim import {path} --out RUN_DIR` makes one of this file" if path.is_file() else ""
        raise ConfigError(f"{path}: no such run directory{hint if path.suffix in ('.neuprim', '.npz', '.ply') else ''}")
    return path


def _task_names() -> str:
    from neuprim.plugins.registry import TASKS, list_tasks

    lines = [f"  {TASKS.word(info)}  ({info.origin})" for info in list_tasks()]
    return "\n".join(["tasks:", *(lines or ["  none is installed"])])
