"""Options and arguments that several commands share."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import click

from taichi_msm.errors import MAX_WORKERS, did_you_mean
from taichi_msm.version import __version__

Command = TypeVar("Command", bound=Callable[..., Any])


class SuggestingChoice(click.Choice):  # type: ignore[type-arg]  # not generic before click 8.2
    """Option type with a fixed set of words; its errors suggest the nearest word."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Validate a word; see `click.ParamType.convert`."""
        try:
            return str(super().convert(value, param, ctx))
        except click.BadParameter as error:
            message = error.message.rstrip(".") + did_you_mean(str(value), [str(word) for word in self.choices])
            raise click.BadParameter(message, ctx, param) from None


def parse_shard(text: str) -> tuple[int, int]:
    """Parse I/N: shard I of N, counted from 1."""
    numbers = re.fullmatch("([0-9]{1,9})/([0-9]{1,9})", text)
    if numbers is None or not 1 <= int(numbers[1]) <= int(numbers[2]):
        raise click.BadParameter(f"{text} is not a shard; take I/N with 1 <= I <= N, such as 3/8")
    return int(numbers[1]), int(numbers[2])


scene_argument = click.argument("scene", metavar="SCENE")


def out_option(help: str, default: str, metavar: str = "DIR") -> Callable[[Command], Command]:  # noqa: A002
    """Return the option of the directory of results."""
    return click.option("--out", metavar=metavar, help=f"{help}  [default: {default}]")


def device_options(command: Command) -> Command:
    """Add the options of the picture and the keys of a scene, and of the device."""
    for option in (threads_option, arch_option, set_option, image_option):
        command = option(command)
    return command


quiet_option = click.option("--quiet", is_flag=True, help="Print no progress and no summary.")
image_option = click.option("--image", metavar="FILE", help="Picture on the sheet, instead of the scene's.")
quality_option = click.option(
    "--quality", type=click.IntRange(1, 100), metavar="N", help="Quality of the MP4 film [%].  [default: 65]"
)
set_option = click.option(
    "--set",
    "overrides",
    metavar="KEY=VALUE",
    multiple=True,
    help="Override a key of the scene, by its dotted path with indices of list items, as probes.0.radius=0.01.",
)
arch_option = click.option(
    "--arch", metavar="cpu|cuda|vulkan", default="cpu", show_default=True, help="Device to compute on."
)
threads_option = click.option(
    "--threads", type=click.IntRange(1, MAX_WORKERS), metavar="N", help="CPU threads.  [default: every core]"
)
workers_option = partial(click.option, "--workers", type=click.IntRange(1, MAX_WORKERS), metavar="N")
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on stdout and nothing else.")


def _print_version(context: click.Context, _option: click.Parameter, requested: bool) -> None:
    """Print the versions of the program and of its compiler, and exit; a callback of click."""
    if requested:
        from taichi_msm.system.compiler import active_compiler

        click.echo(f"taichi-msm {__version__}")
        click.echo(f"{active_compiler().title} {active_compiler().version}")
        context.exit()


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version", is_flag=True, is_eager=True, expose_value=False, callback=_print_version, help="Print the versions."
)
def program() -> None:
    """Simulate the deformation of soft tissue that carries a picture."""
