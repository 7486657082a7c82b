"""``nlosrender doctor``: what this machine has, what is used, what to install."""

from __future__ import annotations

import typer

from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.options import AsJson


def doctor(as_json: AsJson = False) -> None:
    """Show which LLVM, GPU and package versions were found, what a render would use, and what to install.

    Exits with 6 when nothing on this machine can render.

    Example: nlosrender doctor (creates nothing; prints one line per LLVM library found and the one that is used)
    """
    from nlosrender.engine.backend import llvm
    from nlosrender.engine.backend.start import cuda_available, start_backend
    from nlosrender.errors import EXIT_OK, BackendError
    from nlosrender.files.provenance import package_versions

    libraries = llvm.find_libraries()
    has_gpu = cuda_available()
    try:
        backend, trouble = start_backend(), None
    except BackendError as error:
        backend, trouble = None, error
    if as_json:
        found = [{"path": str(x.path), "origin": x.origin, "usable": x.usable, "verdict": x.verdict} for x in libraries]
        report = {"versions": package_versions(), "llvm": found, "gpu": has_gpu}
        report |= {"backend": backend.name if backend else None, "library": backend.library if backend else None}
        OUTPUT.print(report | {"problem": str(trouble) if trouble else None}, trouble.exit_code if trouble else EXIT_OK)
    else:
        typer.echo("versions: " + ", ".join(f"{name} {version}" for name, version in package_versions().items()))
        typer.echo("LLVM libraries:" if libraries else "LLVM libraries: none found")
        for library in libraries:
            typer.echo(
                f"  {'usable ' if library.usable else 'not used'} {library.path} ({library.origin}): {library.verdict}"
            )
        typer.echo(f"NVIDIA GPU: {'found' if has_gpu else 'none found'}")
        if backend:
            typer.echo(f"used: {backend.name} ({backend.library})")
    if trouble is not None:
        raise trouble
