"""``neurosim docs``: the site of the documentation, in the browser, without a network."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import click

import neurosim
from neurosim.base.errors import UserError
from neurosim.base.interrupts import ended_as_usual
from neurosim.cli._common import emit, json_option, page_options

#: The folder of the clone of neurosim.
CLONE = Path(neurosim.__file__).parents[1]


@click.command()
@page_options
@json_option
def docs(port: int, open_browser: bool, seconds: float | None, as_json: bool) -> None:
    """Show the documentation in the browser, without a network.

    It shows the site that "make docs" built, and builds a missing one first. The address works on
    this computer only.
    """
    import webbrowser
    from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    site = str(_site(CLONE))
    try:
        server = ThreadingHTTPServer(("127.0.0.1", port), partial(Quiet, directory=site))
    except OSError as error:
        raise UserError(
            f"port {port} cannot be used ({error.strerror}); choose another one with --port"
        ) from None
    with server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}/index.html"
        emit({"url": url}, as_json, f"Open {url}\nIt works on this computer until Ctrl-C.")
        try:
            if open_browser:
                webbrowser.open(url)
            threading.Event().wait(seconds)
        except KeyboardInterrupt:
            ended_as_usual()
        finally:
            server.shutdown()


def _site(clone: Path) -> Path:
    """Return the folder of the site; build it if there is none.

    Raises:
        UserError: if there is none, and it cannot be built.
    """
    site, builder = clone / "site", clone / "docs" / "make_site.py"
    if (site / "index.html").is_file():
        return site
    if not builder.is_file():
        raise UserError(
            "an installed neurosim has no documentation; clone its repository, and run make docs"
        )
    if not all(map(importlib.util.find_spec, ("zensical", "mkdocstrings"))):
        raise UserError(
            f"the documentation is not built yet: install its builder with pip install "
            f"'neurosim[docs]', and run make docs in {clone}"
        )
    click.echo("building the site, which takes a minute", err=True)
    if subprocess.run([sys.executable, str(builder)], stdout=2).returncode:
        raise UserError("the documentation was not built: see the messages above")
    return site
