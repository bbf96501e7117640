"""``safedpa bench``: how fast, beside a reference measured in the same run."""

from __future__ import annotations

import json

import click

from safedpa.errors import InputError


@click.command()
@click.argument("what", type=click.Choice(["latency"]), default="latency")
@click.option("--seconds", type=float, default=20.0, show_default=True, help="for each of the two measurements")
@click.option("--rate", type=float, default=20.0, show_default=True, help="ticks per second")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
def command(what: str, seconds: float, rate: float, *, as_json: bool) -> None:
    """Measure sense to act over Zenoh, every service its own process, beside a bare chain of relays."""
    from safedpa_services.benchmarks.latency import latency_benchmark

    del what  # one so far
    if not (1.0 <= seconds <= 3600.0 and 1.0 <= rate <= 500.0):
        raise InputError(f"got --seconds {seconds} --rate {rate}, wanted 1 to 3600 s and 1 to 500 ticks per second")
    result = latency_benchmark(seconds, rate)
    if as_json:
        click.echo(json.dumps(result))
        return
    loop, bare = result["real_loop_us"], result["bare_chain_us"]
    click.echo(f"sense to act at {rate:g} Hz for {seconds:g} s, microseconds:")
    click.echo(f"  real loop   p50 {loop['p50']:7.0f}   p99 {loop['p99']:7.0f}   watchdog {loop['watchdog_ticks']}")
    click.echo(f"  bare chain  p50 {bare['p50']:7.0f}   p99 {bare['p99']:7.0f}")
    click.echo(f"  ratio       p50 {result['ratio_p50']:7.2f}   p99 {result['ratio_p99']:7.2f}")
