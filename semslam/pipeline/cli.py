"""The command line: options in, one call into the library, an exit code out. The only place that ends the process.

Exit codes: 0 done, 1 something failed, 2 wrong use, 130 interrupted. Data goes to stdout, everything else to stderr.
"""

from __future__ import annotations

import errno
import json
import math
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click

from semslam import __version__
from semslam.errors import SemslamError, UsageError
from semslam.pipeline.threads import ONE_THREAD

if TYPE_CHECKING:
    from semslam.pipeline.console import Console
    from semslam.pipeline.discover import Log
    from semslam.stages.check import CheckReport
    from semslam.stages.contract import Stage

INTERRUPTED = 130
_Command = TypeVar("_Command", bound=Callable[..., Any])
_SEED = click.IntRange(0, 2**31 - 1)


class _Rate(click.FloatRange):
    """A range that NaN is not in."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        found = super().convert(value, param, ctx)
        if math.isnan(found):
            self.fail(f"{value} is no number.", param, ctx)
        return found


_MODEL_OPTIONS = ("detector", "classes", "segmenter_encoder", "segmenter_decoder")


def main(arguments: Sequence[str] | None = None, stages: Sequence[Stage] | None = None) -> NoReturn:
    """Run the command line and exit; `stages` replaces the catalogue."""
    try:
        os.environ.update(ONE_THREAD)  # before numpy is imported, which reads them once
        signal.signal(signal.SIGTERM, _interrupt)
        code = run_command(arguments, stages)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is said; what is left is to end
    except KeyboardInterrupt:  # while an error was being told
        code = INTERRUPTED
    sys.exit(code)


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def run_command(arguments: Sequence[str] | None, stages: Sequence[Stage] | None) -> int:
    """Run, and turn whatever is thrown into a message and an exit code."""
    as_json = "--json" in (sys.argv[1:] if arguments is None else arguments)
    try:
        result = cli.main(arguments, prog_name="semslam", standalone_mode=False, obj=stages)
        return result if isinstance(result, int) else 0
    except (KeyboardInterrupt, click.Abort):
        _complain("interrupted: run the same command again to resume")
        return INTERRUPTED
    except SemslamError as error:
        return _tell(error, as_json)
    except click.ClickException as error:
        return _tell(UsageError(error.format_message(), hint=_click_hint(error)), as_json)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nobody reads; nothing is left to say
        return 1
    except OSError as error:
        return _tell(_plain_words(error), as_json)


def _tell(error: SemslamError, as_json: bool) -> int:
    """Say it to people, and on stdout to machines that wait for JSON there; the exit code."""
    _console().error(error)
    if as_json:
        _print_json({"error": _error_json(error)})
    return error.exit_code


def _error_json(error: SemslamError) -> dict[str, Any]:
    return {
        "message": error.message,
        "hint": error.hint,
        "details": error.details,
        "exit_code": error.exit_code,
    }


def _plain_words(error: OSError) -> SemslamError:
    """What the system refused, with a hint that fits."""
    from semslam.pipeline.files import out_of_space

    where = f": `{error.filename}`" if error.filename else ""
    if out_of_space(error):
        return SemslamError(f"No space left{where}", hint="free some space, then run the same command again")
    if isinstance(error, PermissionError) or error.errno == errno.EROFS:
        hint = "look at the permissions with `ls -ld`, or name another folder"
    else:
        hint = "check the path and the disk it lies on"
    return SemslamError(f"{error.strerror or error}{where}", hint=hint)


def _click_hint(error: click.ClickException) -> str:
    context = error.ctx if isinstance(error, click.UsageError) else None
    return f"`{context.command_path if context else 'semslam'} --help` shows how"


def _complain(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _console(*, quiet: bool = False) -> Console:
    from semslam.pipeline.console import Console

    return Console(quiet=quiet)


def _print(value: Any, as_json: bool) -> None:
    """Data: its text for people, or its JSON for machines."""
    if as_json:
        _print_json(value.as_json())
    else:
        click.echo(value.text())


def _print_json(value: Any) -> None:
    click.echo(json.dumps(value, indent=1, ensure_ascii=False))


def _stages(context: click.Context) -> tuple[Stage, ...]:
    from semslam.stages.catalogue import STAGES

    return tuple(context.find_root().obj or STAGES)


def _applied(command: _Command, options: Sequence[Callable[[_Command], _Command]]) -> _Command:
    for option in reversed(options):
        command = option(command)
    return command


def _config_options(command: _Command) -> _Command:
    """Options that make a configuration."""
    return _applied(
        command,
        (
            click.option("--config", "config_file", type=click.Path(path_type=Path), help="TOML configuration file."),
            click.option("--set", "assignments", multiple=True, metavar="KEY=VALUE", help="Set one key; repeatable."),
            click.option(
                "--topic", "topics", multiple=True, metavar="ROLE=/TOPIC", help="Topic of a role; repeatable."
            ),
            click.option("--detector", type=click.Path(), help="ONNX file of the detector."),
            click.option("--classes", type=click.Path(), help="Text file with its class names."),
            click.option("--segmenter-encoder", type=click.Path(), help="ONNX file of the segmenter's image encoder."),
            click.option("--segmenter-decoder", type=click.Path(), help="ONNX file of the segmenter's mask decoder."),
            click.option("--estimator", "estimators", multiple=True, metavar="NAME", help="Estimator; repeatable."),
            click.option("--prior", type=click.Path(), help="Map made before: results/LOG/surfel of an output folder."),
        ),
    )


def _run_options(command: _Command) -> _Command:
    """Options of the commands that run stages."""
    own = (
        click.argument("logs", nargs=-1, required=True),
        click.option("--out", type=click.Path(path_type=Path), default=Path("out"), show_default=True, help="Folder."),
    )
    end = (
        click.option("--workers", type=click.IntRange(0), help="Processes; 0: none but this. Default: by processors."),
        _json_option,
        click.option("--quiet", is_flag=True, help="Only warnings and errors."),
    )
    return _applied(_config_options(_applied(command, end)), own)


_VARIANTS = "Kind of homes: standard, plain, repeating, symmetric, rooms, person; repeatable."
_json_option = click.option("--json", "as_json", is_flag=True, help="JSON on stdout.")
_out_argument = click.argument("out", type=click.Path(path_type=Path))


def _settings(given: Mapping[str, Any]) -> dict[str, Any]:
    """The options that stand for configuration keys, as {"section.key": value}."""
    settings: dict[str, Any] = {
        f"extract.{name}": os.path.abspath(given[name]) for name in _MODEL_OPTIONS if given.get(name)
    }
    for text in given.get("topics", ()):
        role, equals, topic = text.partition("=")
        if not (role and equals and topic):
            raise UsageError(f"`--topic {text}` is not of the form ROLE=/TOPIC", hint="`--topic depth=/camera/depth`")
        settings[f"ingest.topics.{role}"] = topic
    if given.get("estimators"):
        settings["localize.estimators"] = list(given["estimators"])
    if given.get("prior"):
        settings["localize.surfel.prior"] = _prior(Path(given["prior"]))
        if "surfel" not in settings.get("localize.estimators", ["surfel"]):
            raise UsageError(
                "`--prior` is for the estimator `surfel`, which is not among those named",
                hint="add `--estimator surfel`",
            )
        elsewhere = given.get("config_file") or any(
            text.startswith("localize.estimators=") for text in given.get("assignments", ())
        )
        if not elsewhere:
            settings.setdefault("localize.estimators", ["surfel"])
    return settings


def _prior(path: Path) -> str:
    """The file of a map made before: named itself, or the folder of results that holds it."""
    file = path / "places.parquet" if path.is_dir() else path
    if not file.is_file():
        raise UsageError(
            f"`--prior {path}` is no map made before: there is no `{file.name if path.is_dir() else path}`",
            hint="make one with `semslam run LOG --estimator surfel --out OUT`, then `--prior OUT/results/LOG/surfel`",
        )
    return str(file.resolve())


def _run(context: click.Context, until: str, given: Mapping[str, Any]) -> int:
    """Run the stages up to `until`; the exit code."""
    from semslam.pipeline.run import RunRequest, run

    request = RunRequest(
        names=given["logs"],
        out=given["out"],
        until=until,
        command=context.command.name or "run",
        config_file=given["config_file"],
        assignments=given["assignments"],
        options=_settings(given),
        workers=given["workers"],
    )
    outcome = run(request, _stages(context), _console(quiet=given["quiet"]))
    if given["as_json"]:
        _print_json(outcome.as_json())
    return outcome.exit_code


class _InOrder(click.Group):
    """Lists its commands in the order in which people need them."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Names as they were added."""
        return list(self.commands)


@click.group(cls=_InOrder, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="semslam", message="%(prog)s %(version)s")
def cli() -> None:
    """Pose tracks and semantic maps from MCAP robot logs, offline and in batch.

    \b
    Example:
      semslam run kitchen.mcap --detector yolox.onnx --classes coco.txt --out OUT
    """


@cli.command()
@click.option("--out", type=click.Path(path_type=Path), default=Path("semslam_demo"), show_default=True, help="Folder.")
@click.option("--workers", type=click.IntRange(0), help="Processes; 0: none but this. Default: by processors.")
@_json_option
@click.option("--quiet", is_flag=True, help="Only warnings and errors.")
@click.pass_context
def demo(context: click.Context, out: Path, workers: int | None, as_json: bool, quiet: bool) -> int:
    """Try it on a bundled log.

    Makes the map of a furnished home from half a minute of a small robot's log. Opens nothing; says where to look.

    \b
    Example:
      semslam demo --out semslam_demo
    """
    from semslam.pipeline.demo import demo_log
    from semslam.pipeline.run import RunRequest, run

    log = demo_log()
    console = _console(quiet=quiet)
    request = RunRequest([str(log)], out, _stages(context)[-1].name, "demo", workers=workers)
    outcome = run(request, _stages(context), console)
    if as_json:
        _print_json(outcome.as_json())
    elif not outcome.exit_code:
        console.say(f"log: {log}\nnext: `semslam evaluate {out}` compares the tracks with the simulated truth")
    return outcome.exit_code


@cli.command()
@click.argument("out", type=click.Path(path_type=Path), default=Path("indoor_scenes"))
@click.option("--scenes", type=int, default=30, show_default=True, help="Homes of every variant.")
@click.option("--trajectories", type=int, default=3, show_default=True, help="Logs of every home and day.")
@click.option("--steps", type=int, default=80, show_default=True, help="Keyframes of a log.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of everything random.")
@click.option(
    "--variant", "variants", multiple=True, default=("standard",), show_default=True, metavar="NAME", help=_VARIANTS
)
@click.option("--days", type=int, default=1, show_default=True, help="2: every home again, with furniture moved.")
@click.option("--rate", type=float, default=1.0, show_default=True, metavar="HZ", help="Most keyframes a second.")
@click.option("--noise", default="standard", show_default=True, help="Of IMU and wheels: none, half, standard, triple.")
@click.option("--size", default="640x480", show_default=True, metavar="WxH", help="Of the pictures, in pixels.")
@click.option("--workers", type=click.IntRange(0), help="Processes; 0: none but this. Default: by processors.")
@click.option("--replace", is_flag=True, help="Make anew what OUT holds with other options.")
@click.option("--verify", is_flag=True, help="Read finished logs to see that they are whole.")
@_json_option
@click.option("--quiet", is_flag=True, help="Only warnings and errors.")
def simulate(out: Path, workers: int | None, as_json: bool, quiet: bool, **given: Any) -> int:
    """Record simulated homes as ordinary MCAP logs, with exact truth.

    OUT gets logs/, truth/ and splits.parquet, the same bytes whenever the options are the same. Killed, it goes on
    where it was; with more scenes or trajectories it grows. Needs `pip install 'semslam[sim]'`.

    \b
    Example:
      semslam simulate --scenes 4 --trajectories 3 --variant standard --variant rooms
    """
    from semslam.pipeline.simulate_view import SimulateView, say_simulated
    from semslam.sim.dataset import Recipe, size_of
    from semslam.sim.engine import require_engine
    from semslam.sim.simulate import simulate as make

    replace, verify = given.pop("replace"), given.pop("verify")
    width, height = size_of(given.pop("size"))
    recipe = Recipe(rate_hz=given.pop("rate"), width=width, height=height, **given)
    require_engine()
    console = _console(quiet=quiet)
    view = SimulateView(console)
    try:
        report = make(out, recipe, workers=workers, replace=replace, verify=verify, listener=view)
    finally:
        view.close()
    say_simulated(console, report)
    if as_json:
        _print_json(report.as_json())
    return 1 if report.failures else 0


@cli.command()
@_run_options
@click.pass_context
def run(context: click.Context, /, **given: Any) -> int:
    """Run everything: ingest, extract, localize, export.

    LOGS are files, folders (searched for *.mcap) or globs. A killed run goes on where it was; what is done is not
    done again unless its input or configuration changed.

    \b
    Example:
      semslam run kitchen.mcap --detector yolox.onnx --classes coco.txt --out OUT
    """
    return _run(context, _stages(context)[-1].name, given)


@cli.command()
@_run_options
@click.option("--check", is_flag=True, help="Only report what the logs hold and whether they will do.")
@click.pass_context
def ingest(context: click.Context, /, check: bool, **given: Any) -> int:
    """Read logs into levelled keyframes and motion.

    LOGS are files, folders or globs.

    \b
    Example:
      semslam ingest kitchen.mcap --check
    """
    return _check(context, given) if check else _run(context, "ingest", given)


@cli.command()
@_run_options
@click.pass_context
def extract(context: click.Context, /, **given: Any) -> int:
    """Find objects and project them onto the floor.

    Runs what it needs before: ingest.

    \b
    Example:
      semslam extract logs/ --detector yolox.onnx --classes coco.txt --out OUT
    """
    return _run(context, "extract", given)


@cli.command()
@_run_options
@click.pass_context
def localize(context: click.Context, /, **given: Any) -> int:
    """Estimate poses and maps.

    Runs what it needs before: ingest, extract.

    \b
    Example:
      semslam localize logs/ --estimator paper --config home.toml --out OUT
    """
    return _run(context, "localize", given)


@cli.command()
@_run_options
@click.pass_context
def export(context: click.Context, /, **given: Any) -> int:
    """Write maps and trajectories as files.

    Runs what it needs before: ingest, extract, localize.

    \b
    Example:
      semslam export logs/ --config home.toml --out OUT
    """
    return _run(context, "export", given)


@cli.command()
@_out_argument
@click.option("--log", "logs", multiple=True, metavar="NAME", help="Log of OUT; repeatable. Default: all.")
@click.option("--into", type=click.Path(path_type=Path), help="Folder of the sites. Default: OUT/sites.")
@_json_option
@click.option("--quiet", is_flag=True, help="Only warnings and errors.")
@click.pass_context
def merge(
    context: click.Context, out: Path, logs: tuple[str, ...], into: Path | None, as_json: bool, quiet: bool
) -> None:
    """Bring logs of one place into one map and one frame.

    OUT is the folder of a finished run with the estimator surfel. Its logs are sorted into sites without a first guess;
    all keyframes of a site are aligned with each other. A log that is lost or ambiguous stays a site of its own.

    \b
    Example:
      semslam merge OUT --log monday --log tuesday --into maps
    """
    from semslam.pipeline.folder import open_folder
    from semslam.pipeline.merge import MergeRequest, merge_run
    from semslam.pipeline.merge_view import MergeView, say_merged

    console = _console(quiet=quiet)
    view = MergeView(console)
    try:
        report = merge_run(MergeRequest(open_folder(out), logs, into), _stages(context), view.progressed)
    except KeyboardInterrupt:
        view.close()
        _complain("interrupted: the same command starts anew")
        context.exit(INTERRUPTED)
    finally:
        view.close()
    say_merged(console, report)
    _print(report, as_json)


@cli.command()
@_out_argument
@_json_option
def evaluate(out: Path, as_json: bool) -> None:
    """Compare all tracks with ground truth.

    Stands beside them: `dead_reckoning` (motion alone), `chance` (random poses) and `standstill` (no motion at all).

    \b
    Example:
      semslam evaluate OUT
    """
    from semslam.pipeline.evaluate import evaluate_run
    from semslam.pipeline.folder import open_folder

    evaluation = evaluate_run(open_folder(out))
    for note in evaluation.notes:
        _console().warn(note)
    _print(evaluation, as_json)


@cli.command()
@_out_argument
@_json_option
@click.pass_context
def status(context: click.Context, out: Path, as_json: bool) -> None:
    """Show what an output folder holds.

    \b
    Example:
      semslam status OUT
    """
    from semslam.pipeline.folder import open_folder
    from semslam.pipeline.status import status as look

    _print(look(open_folder(out), _stages(context)), as_json)


@cli.command()
@click.argument("stage")
@click.argument("log")
@click.option("--out", type=click.Path(path_type=Path), default=Path("out"), show_default=True, help="Output folder.")
@_config_options
@_json_option
@click.pass_context
def why(context: click.Context, /, stage: str, log: str, out: Path, as_json: bool, **given: Any) -> None:
    """Explain why a stage ran, or would run.

    STAGE may name a variant (localize/paper), LOG is a name that `semslam status` shows or a file. The next run is
    taken to have the configuration of the last one, changed by the options given here, or that of --config.

    \b
    Example:
      semslam why extract kitchen --out OUT --set extract.min_score=0.4
    """
    from semslam.pipeline.config import load_config
    from semslam.pipeline.folder import open_folder
    from semslam.pipeline.why import as_json as reasons_json
    from semslam.pipeline.why import find_record
    from semslam.pipeline.why import why as explain

    folder = open_folder(out)
    record = find_record(folder, log)
    stored = None if given["config_file"] else record.config
    config = load_config(_stages(context), given["config_file"], given["assignments"], _settings(given), stored)
    reasons = explain(folder, _stages(context), stage, record, config)
    if as_json:
        _print_json(reasons_json(record.name, reasons))
    else:
        click.echo("\n".join(reason.text() for reason in reasons))


@cli.command()
@_out_argument
@click.option("--rederive", is_flag=True, help="Also make every result again and compare.")
@click.option("--remove", is_flag=True, help="Remove damaged entries; the next run makes them anew.")
@click.option("--workers", type=click.IntRange(0), help="Processes for --rederive.")
@_json_option
@click.pass_context
def verify(context: click.Context, out: Path, rederive: bool, remove: bool, workers: int | None, as_json: bool) -> int:
    """Check everything stored for damage.

    Exit code 1 if anything is damaged, missing or different.

    \b
    Example:
      semslam verify OUT --rederive
    """
    from semslam.pipeline.folder import open_folder
    from semslam.pipeline.verify import verify_folder

    report = verify_folder(open_folder(out), _stages(context), _console(), again=rederive, drop=remove, workers=workers)
    _print(report, as_json)
    return 0 if report.ok else 1


@cli.command()
@_out_argument
@click.option("--all", "everything", is_flag=True, help="All entries and records; only results stay.")
@click.option("--forget", default="", metavar="LOG", help="Also forget this log: its record and its results.")
@click.option("--dry-run", is_flag=True, help="Only say what would be removed.")
@_json_option
def clean(out: Path, everything: bool, forget: str, dry_run: bool, as_json: bool) -> None:
    """Remove what no log refers to any more.

    Entries that no log uses, unfinished work, temporary files, results of logs and variants that are gone. The log
    files themselves are never touched.

    \b
    Example:
      semslam clean OUT --dry-run
    """
    from semslam.pipeline.clean import clean as clean_folder
    from semslam.pipeline.folder import open_folder

    folder = open_folder(out)
    with folder.locked():
        report = clean_folder(folder, everything=everything, dry_run=dry_run, forget=forget)
    _print(report, as_json)


@cli.group()
def config() -> None:
    """Show or check a configuration.

    \b
    Example:
      semslam config show > home.toml
    """


@config.command("show")
@_config_options
@click.option("--defaults", is_flag=True, help="The defaults, whatever else is given.")
@click.pass_context
def config_show(context: click.Context, /, defaults: bool, **given: Any) -> None:
    """Print the whole configuration as TOML, every key documented.

    \b
    Example:
      semslam config show --config home.toml --set extract.min_score=0.4
    """
    from semslam.pipeline.config import as_toml, load_config

    if defaults:
        shown = load_config(_stages(context))
    else:
        shown = load_config(_stages(context), given["config_file"], given["assignments"], _settings(given))
    click.echo(as_toml(shown), nl=False)


@config.command("check")
@click.argument("file", type=click.Path(path_type=Path))
@click.pass_context
def config_check(context: click.Context, file: Path) -> None:
    """Check a configuration file: keys, types, ranges, and that the files it names exist and will do.

    \b
    Example:
      semslam config check home.toml
    """
    from semslam.pipeline.config import check_files, load_config
    from semslam.pipeline.preflight import check_stages

    loaded = load_config(_stages(context), file)
    check_files(loaded)
    check_stages(loaded, _stages(context), detector_later=True)
    click.echo(f"{file}: ok")


@cli.group()
def train() -> None:
    """Make training pictures, and train semslam's own networks.

    \b
    Example:
      semslam train pictures views --homes 120 --views 20 --seed 1000
      semslam train detector views --out runs/detector
    """


@train.command("pictures")
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--homes", type=int, default=120, show_default=True, help="Simulated homes.")
@click.option("--views", type=int, default=20, show_default=True, help="Pictures of each.")
@click.option("--seed", type=int, default=1000, show_default=True, help="Homes of `semslam simulate --seed`.")
@click.option("--unfamiliar", is_flag=True, help="Lights, palettes and cameras that training never uses; for tests.")
@click.option("--workers", type=click.IntRange(0), help="Processes; 0: none but this. Default: by processors.")
@_json_option
@click.option("--quiet", is_flag=True, help="Only warnings and errors.")
def train_pictures(out: Path, workers: int | None, as_json: bool, quiet: bool, **given: Any) -> int:
    """Draw views of simulated homes with the truth to learn from.

    OUT gets a Parquet file a home (table 15 of data_spec.md). Killed, it goes on where it was; with more homes it
    grows. Needs `pip install 'semslam[sim]'`.

    \b
    Example:
      semslam train pictures views --homes 120 --views 20 --seed 1000
    """
    from semslam.pipeline.train_view import PicturesView, say_pictures
    from semslam.sim.engine import require_engine
    from semslam.sim.views import ViewRecipe, make_views

    recipe = ViewRecipe(**given)
    require_engine()
    console = _console(quiet=quiet)
    view = PicturesView(console)
    try:
        report = make_views(out, recipe, workers=workers, progress=view.progressed)
    finally:
        view.close()
    say_pictures(console, report)
    if as_json:
        _print_json({"out": str(out), "cached": report.cached, "done": report.done, "failed": report.failures})
    return 1 if report.failures else 0


def _schedule_options(unit: str, threads: int) -> tuple[Callable[..., Any], ...]:
    """How long and how fast to train; `unit` is what a batch counts."""
    return (
        click.option("--steps", type=click.IntRange(1), help="Default: as the shipped model."),
        click.option("--batch", type=click.IntRange(1), help=f"{unit} a step. Default: as the shipped model."),
        click.option("--rate", type=_Rate(0, 1, min_open=True), help="Peak learning rate. Default: likewise."),
        click.option("--seed", type=_SEED, default=1, show_default=True, help="Of everything random."),
        click.option("--threads", type=click.IntRange(1, 64), default=threads, show_default=True, help="Of torch."),
        click.option("--device", type=click.Choice(("auto", "cpu", "cuda")), default="auto", show_default=True),
        click.option("--quiet", is_flag=True, help="Only warnings and errors."),
    )


def _training_options(command: _Command) -> _Command:
    """Options of the commands that train on views."""
    own = (
        click.argument("views", type=click.Path(path_type=Path)),
        click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the run."),
        click.option("--test", type=click.Path(path_type=Path), help="Views of other homes, to judge the result."),
    )
    return _applied(command, (*own, *_schedule_options("Pictures", threads=2)))


def _drives_options(unit: str, *own: Callable[..., Any]) -> Callable[[_Command], _Command]:
    """Options of the commands that train on the drives of a data set, and a command's own ones among them."""
    shared = (
        click.argument("dataset", type=click.Path(path_type=Path)),
        click.option(
            "--run", "run_folder", type=click.Path(path_type=Path), help="Output folder of a run over its logs."
        ),
        click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the training."),
        click.option("--protocol", type=click.Choice(("cross", "intra")), default="cross", show_default=True),
    )
    return lambda command: _applied(command, (*shared, *own, *_schedule_options(unit, threads=1)))


def _train(task: str, given: dict[str, Any]) -> int:
    """Train a network of a kind and say what came of it."""
    from semslam.models.extras import require_torch
    from semslam.pipeline.train_view import TrainingView

    require_torch()
    from semslam.models.training.runs import TASKS, asked

    console = _console(quiet=given.pop("quiet"))
    view = TrainingView(console)
    try:
        made = TASKS[task].train(asked(task, watch=view.progressed, **given))
    finally:
        view.close()
    for path in made:
        console.say(f"wrote {path}")
    return 0


@train.command("detector")
@_training_options
def train_detector(**given: Any) -> int:
    """Train the detector on VIEWS and export it as ONNX.

    The run's folder holds a checkpoint: killed, the same command goes on where it was; `curves.csv` has the losses.
    Needs `pip install 'semslam[train]'`.

    \b
    Example:
      semslam train detector views --out runs/detector
    """
    return _train("detector", given)


@train.command("segmenter")
@_training_options
def train_segmenter(**given: Any) -> int:
    """Train the box-prompted segmenter on VIEWS and export encoder and decoder as ONNX.

    The run's folder holds a checkpoint: killed, the same command goes on where it was; `curves.csv` has the losses.
    Needs `pip install 'semslam[train]'`.

    \b
    Example:
      semslam train segmenter views --out runs/segmenter
    """
    return _train("segmenter", given)


@train.command("mapper")
@_drives_options(
    "Drives",
    click.option("--quality", type=click.Choice(("real", "obstructed", "ideal")), default="real", show_default=True),
    click.option("--kernel", type=click.Choice(("3", "1")), default="3", show_default=True, help="1: an LSTM a cell."),
    click.option("--side", type=click.IntRange(3), default=11, show_default=True, help="Cells of an observation; odd."),
    click.option("--binary", is_flag=True, help="Observation cells above the noise floor count as 1."),
    click.option(
        "--own", type=click.FloatRange(0, 1), default=0.5, show_default=True, help="Share of own poses at the end."
    ),
    click.option(
        "--length", type=click.IntRange(2), default=40, show_default=True, help="Keyframes of a drive, from its start."
    ),
)
def train_mapper(**given: Any) -> int:
    """Train the map update (equation 8) on the drives of DATASET and export it as ONNX.

    DATASET is a folder of `semslam simulate`. Real-camera observations and motion come from a run over its logs;
    without one, train on its own qualities with true poses. The training's folder holds a checkpoint: killed, the same
    command goes on where it was; `curves.csv` has the losses. Needs `pip install 'semslam[train]'`.

    \b
    Example:
      semslam run homes/logs --out out
      semslam train mapper homes --run out --out runs/mapper
    """
    from semslam.models.extras import require_torch

    require_torch()
    from semslam.pipeline.train_mapper import MapperRequest, train_on_drives

    console = _console(quiet=given.pop("quiet"))
    for path in train_on_drives(console, MapperRequest(**given)):
        console.say(f"wrote {path}")
    return 0


def _train_on_pictures(task: str, given: dict[str, Any]) -> int:
    """Train a network that learns motion from pictures in a row, and say what came of it."""
    from semslam.models.extras import require_torch

    require_torch()
    from semslam.pipeline.train_request import DrivesRequest
    from semslam.pipeline.train_sequences import train_sequences

    console = _console(quiet=given.pop("quiet"))
    for path in train_sequences(console, task, DrivesRequest(**given)):
        console.say(f"wrote {path}")
    return 0


@train.command("mapnet")
@_drives_options("Sequences")
def train_mapnet(**given: Any) -> int:
    """Train MapNet on the drives of DATASET and export it as ONNX.

    DATASET is a folder of `semslam simulate`; keyframes come from a run over its logs, of which `ingest` is enough. The
    training's folder holds thumbnails and a checkpoint: killed, the same command goes on where it was. Its card
    says what the network is worth on the logs that test. Needs `pip install 'semslam[train]'`.

    \b
    Example:
      semslam ingest homes/logs --out out
      semslam train mapnet homes --run out --out runs/mapnet
    """
    return _train_on_pictures("mapnet", given)


@train.command("deepvo")
@_drives_options("Sequences")
def train_deepvo(**given: Any) -> int:
    """Train DeepVO on the drives of DATASET and export it as ONNX.

    DATASET is a folder of `semslam simulate`; keyframes come from a run over its logs, of which `ingest` is enough. The
    training's folder holds thumbnails and a checkpoint: killed, the same command goes on where it was. Its card
    says what the network is worth on the logs that test. Needs `pip install 'semslam[train]'`.

    \b
    Example:
      semslam ingest homes/logs --out out
      semslam train deepvo homes --run out --out runs/deepvo
    """
    return _train_on_pictures("deepvo", given)


@cli.group()
def bench() -> None:
    """Measure again what was claimed.

    \b
    Example:
      semslam bench paper homes --out out/paper
    """


@bench.command("paper")
@click.argument("dataset", type=click.Path(path_type=Path), required=False)
@click.option("--out", type=click.Path(path_type=Path), default=Path("bench_paper"), show_default=True, help="Folder.")
@click.option("--rows", multiple=True, metavar="NAME", help="Row of a table, `maps` (table 4) or `noise`; repeatable.")
@click.option("--seeds", type=click.IntRange(1, 100), default=3, show_default=True, help="Trainings of each network.")
@click.option("--steps", type=click.IntRange(2), default=30, show_default=True, help="Keyframes scored of a drive.")
@click.option("--run", type=click.Path(path_type=Path), help="Output folder of a run over its logs, to build on.")
@click.option("--device", type=click.Choice(("cpu", "cuda")), default="cpu", show_default=True, help="Of trainings.")
@click.option("--quick", is_flag=True, help="Try every path on two tiny homes; the figures mean nothing.")
@click.option("--config", "config_file", type=click.Path(path_type=Path), help="TOML configuration file.")
@click.option("--set", "assignments", multiple=True, metavar="KEY=VALUE", help="Set one key; repeatable.")
@click.option("--workers", type=click.IntRange(0), help="Processes; 0: none but this. Default: by processors.")
@_json_option
@click.option("--quiet", is_flag=True, help="Only warnings and errors.")
@click.pass_context
def bench_paper_command(
    context: click.Context, /, dataset: Path | None, out: Path, as_json: bool, quiet: bool, **given: Any
) -> int:
    """Regenerate the paper's tables and figures on DATASET, beside its own figures.

    DATASET is a folder of `semslam simulate`; --quick makes a tiny one if none is named. OUT/results/README.md holds
    it all. Killed, the same command goes on where it was. What cannot be run is listed with the reason. Needs
    `pip install 'semslam[report,sim,train]'`.

    \b
    Example:
      semslam simulate homes && semslam bench paper homes --out out/paper
      semslam bench paper --quick
    """
    from semslam.bench.paper import bench_paper
    from semslam.bench.work import BenchRequest

    if dataset is None and not given["quick"]:
        raise UsageError("No data set was named", hint="make one with `semslam simulate homes`, or add `--quick`")
    console = _console(quiet=quiet)
    request = BenchRequest(dataset or _tiny_homes(out / "homes", given["workers"], console), out, **given)
    report = bench_paper(request, _stages(context), console)
    if as_json:
        _print_json(report.as_json())
    return 1 if report.empty else 0


def _tiny_homes(folder: Path, workers: int | None, console: Console) -> Path:
    """Two homes with two short drives each, as a data set."""
    from semslam.sim.dataset import Recipe
    from semslam.sim.engine import require_engine
    from semslam.sim.simulate import simulate as make

    require_engine()
    console.say(f"simulate two tiny homes in {folder}")
    report = make(folder, Recipe(scenes=2, trajectories=2, steps=4, width=160, height=120), workers=workers)
    if report.failures:
        logs = ", ".join(f"`{one.recording.name}`" for one in report.failures)
        raise SemslamError(f"Of the tiny homes {logs} could not be simulated", hint="`semslam simulate` says why")
    return folder


@cli.group()
def models() -> None:
    """Look at networks and export them.

    \b
    Example:
      semslam models inspect yolox.onnx
    """


@models.command("inspect")
@click.argument("file", type=click.Path(path_type=Path))
@_json_option
def models_inspect(file: Path, as_json: bool) -> None:
    """Show inputs, outputs and metadata of an ONNX file, and what semslam takes it for.

    \b
    Example:
      semslam models inspect yolox.onnx
    """
    from semslam.models.inspect import describe

    _print(describe(file), as_json)


@models.command("export")
@click.argument("task", type=click.Choice(("detector", "segmenter", "mapper", "mapnet", "deepvo")))
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--run", "run_folder", type=click.Path(path_type=Path), help="Folder of a training, finished or not.")
@click.option("--random", "random_seed", type=_SEED, metavar="SEED", help="Randomly initialised instead, from a seed.")
@click.option(
    "--classes", type=click.Path(path_type=Path), help="Class names of a random one. Default: simulated homes."
)
def models_export(task: str, out: Path, run_folder: Path | None, random_seed: int | None, classes: Path | None) -> int:
    """Write a network of semslam's own as ONNX into the folder OUT.

    \b
    Example:
      semslam models export detector exported --run runs/detector
      semslam models export mapnet exported --random 1
    """
    from semslam.models.extras import require_torch

    if (run_folder is None) == (random_seed is None):
        raise UsageError("Export what a training learned, or random weights", hint="give `--run` or `--random`")
    if classes is not None and (run_folder is not None or task not in ("detector", "mapper")):
        raise UsageError("`--classes` names the classes of a random detector or mapper alone", hint="leave it out")
    require_torch()
    from semslam.models.training.runs import EXPORTS

    for path in EXPORTS[task](out, run_folder, random_seed, classes):
        _complain(f"wrote {path}")
    return 0


def _check(context: click.Context, given: Mapping[str, Any]) -> int:
    """`ingest --check`: a report and a picture for every log; 1 if one will not do or cannot be told."""
    from semslam.pipeline.config import load_config
    from semslam.pipeline.discover import discover
    from semslam.pipeline.preflight import check_stages

    stages = _stages(context)
    resolved = load_config(stages, given["config_file"], given["assignments"], _settings(given))
    check_stages(resolved, stages[:1])
    found = discover(given["logs"])
    for warning in found.warnings:
        _console().warn(warning)
    explicit = context.get_parameter_source("out") == click.core.ParameterSource.COMMANDLINE
    pictures = given["out"] if explicit else Path()
    told: list[CheckReport | SemslamError] = []
    errors = [SemslamError(f"`{problem.path}` was left out: {problem.reason}") for problem in found.problems]
    for log in found.logs:
        report, problem = _check_one(log, resolved.of(stages[0]), pictures)
        told += [report] if report else [problem] if problem else []
        errors += [problem] if problem else []
    reports = [one for one in told if not isinstance(one, SemslamError)]
    if given["as_json"]:
        _print_json([{"error": _error_json(x)} if isinstance(x, SemslamError) else x.as_json() for x in told])
    elif reports:
        click.echo("\n\n".join(report.text() for report in reports))
    for error in errors:
        _console().error(error)
    return 0 if all(report.ok for report in reports) and not errors else 1


def _check_one(log: Log, config: Any, pictures: Path) -> tuple[CheckReport | None, SemslamError | None]:
    """The report of one log and what went wrong; a picture that cannot be put in place does not cost the report."""
    import shutil
    import tempfile
    from dataclasses import replace

    from semslam.pipeline.folder import CHECK_PICTURE
    from semslam.stages.check import check_log

    name = f"{log.name}{CHECK_PICTURE}"
    try:
        with tempfile.TemporaryDirectory(prefix="semslam-") as temporary:
            report = check_log(log.sources, config, Path(temporary, name))
            if report.picture is None:
                return report, None
            try:
                pictures.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(report.picture, pictures / name)
            except OSError as error:
                problem = SemslamError(
                    f"Picture `{pictures / name}` cannot be written: {error.strerror}",
                    hint="name another folder with `--out`",
                )
                return replace(report, picture=None), problem
            return replace(report, picture=str(pictures / name)), None
    except SemslamError as error:
        return None, error


if __name__ == "__main__":
    main()
