"""Command `ldo`: its verbs, and the handling of errors.

Exit codes: 0 success, 1 other errors, 2 bad arguments or configuration, 3 bad input data, 4 an
actor failed, 5 a replay diverged, 6 a port, service or state folder cannot be used now, 130
interrupted. An error is printed as one paragraph; --debug adds the traceback.
"""

import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence

from rich.console import Console

from ldo_service.errors import ConfigError, LdoError, did_you_mean

from .arguments import parse
from .log_format import OneLineFormatter

# Verbs that keep their partial results when they are interrupted.
KEEPING = ("batch", "demo", "run", "suite")
HELP = """\
usage: ldo VERB ...

RGB-D SLAM as a service: poses and a photo-realistic map, live, on a CPU.

first steps:
  ldo demo                      track, map and label a built-in synthetic room
  ldo run SOURCE --out DIR      track and map a data set
  ldo eval DIR SOURCE           evaluate the trajectory and the map of a run
  ldo serve                     run the live service; `ldo publish SOURCE` sends frames to it

verbs:
{verbs}

`ldo VERB --help` explains a verb. `--debug` shows the traceback of an error."""

# Option names of version 0.1 that this version still accepts, and their new names.
OLD_OPTIONS = {"--localise": "--localize"}
# Option names of version 0.1 that are refused; the error states the new name.
RENAMED_OPTIONS = {
    "--elsewhere": "--gaussians-out-of-view",
    "--front-end": "--reuse-front-end",
    "--hold-out": "--hold-out-every",
    "--join": "--client",
    "--licence": "--license",
    "--metrics": "--metrics-port",
    "--only": "--actor",
    "--prior": "--odometry-prior",
    "--refine": "--refine-iterations",
    "--without-keys": "--insecure",
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run `ldo` with `arguments`, or with the arguments of the process if None, and exit."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [OLD_OPTIONS.get(word, word) for word in words if word != "--debug"]
    logging.basicConfig(level=logging.DEBUG if debug else logging.INFO)
    for handler in logging.getLogger().handlers:
        handler.setFormatter(OneLineFormatter())
    if not debug:
        for library in ("httpx2", "aiobotocore", "botocore"):  # INFO has a line per request.
            logging.getLogger(library).setLevel(logging.WARNING)
    _end_on_interrupts()
    known = verbs()
    _raise_on_interrupts()
    try:
        _refuse_renamed_options(words)
        if not words or words[0] in ("-h", "--help"):
            print(HELP.format(verbs="\n".join(first_lines())))
            sys.exit(0 if words else 2)
        parse(_verb(words[0], known), words[0], words[1:])()
    except LdoError as error:
        if debug:
            raise
        Console(stderr=True, highlight=False, markup=False).print(f"ldo: {error}", soft_wrap=True)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        kept = "; partial results are kept" if words[0] in KEEPING else ""
        Console(stderr=True).print(f"ldo: interrupted{kept}.")
        sys.exit(130)
    except BrokenPipeError:  # The reader of a pipe closed it, as in `ldo topics | head`.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _verb(name: str, known: dict[str, Callable[..., None]]) -> Callable[..., None]:
    """Return the function of a verb.

    Raises:
        ConfigError: There is no verb with this name.
    """
    if name not in known:
        hint = did_you_mean(name, known, "`ldo --help` lists all commands.")
        raise ConfigError(f"there is no command {name!r}. {hint}")
    return known[name]


def _end_on_interrupts() -> None:
    """Let SIGINT and SIGTERM end the process immediately, with exit code 130.

    These handlers are used while modules are imported, when nothing needs an orderly end. An
    exception is no alternative: raised in the initialization of an extension module, it becomes an
    ImportError. The default action of the signals is no alternative either: the kernel ignores it
    in process 1, and the service is process 1 in a container.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(130))


def _raise_on_interrupts() -> None:
    """Make SIGINT and SIGTERM raise KeyboardInterrupt.

    The handler must be installed explicitly: a shell without job control starts `ldo view &` with
    SIGINT ignored, and Python keeps that setting.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)


def _refuse_renamed_options(words: Sequence[str]) -> None:
    """Check that no option has been renamed.

    Raises:
        ConfigError: An option has been renamed; the message states the new name.
    """
    for word in words:
        option = word.partition("=")[0]
        if option in RENAMED_OPTIONS:
            raise ConfigError(
                f"the option {option} is now {RENAMED_OPTIONS[option]}. Use the new name."
            )


def first_lines() -> Iterator[str]:
    """Yield each verb with the first line of its help."""
    for name, verb in verbs().items():
        yield f"  {name:<10}{(verb.__doc__ or '').strip().splitlines()[0]}"


def verbs() -> dict[str, Callable[..., None]]:
    """Return the function of each verb, by name; the function's docstring is the help text."""
    from ldo_service.commands import (
        batch,
        bench,
        control,
        demo,
        doctor,
        evaluate,
        export,
        info,
        keys,
        models,
        publish,
        query,
        replay,
        run,
        serve,
        show_config,
        simulate,
        suite,
        topics,
        view,
    )

    return {
        "demo": demo.demo,
        "run": run.run,
        "info": info.info,
        "eval": evaluate.evaluate,
        "batch": batch.batch,
        "suite": suite.suite,
        "query": query.query,
        "view": view.view,
        "export": export.export,
        "serve": serve.serve,
        "publish": publish.publish,
        "control": control.control,
        "record": serve.record,
        "replay": replay.replay,
        "simulate": simulate.simulate,
        "models": models.models,
        "keys": keys.keys,
        "topics": topics.topics,
        "config": show_config.show_config,
        "bench": bench.bench,
        "doctor": doctor.doctor,
    }
