#!/usr/bin/env python3
"""Build, list and sign a release: `python packaging/release.py --key KEY.pem [--out DIR]`.

A release is a folder with wheels, source archive, Debian packages and bill of materials
(CycloneDX). ``SHA256SUMS`` contains the checksum of each of these files. ``SHA256SUMS.sig`` is the
Ed25519 signature of that list. KEY.pem is a private key, which only ``openssl`` reads.

Invariant: the folder exists only if it is complete and its signature was verified.
"""

from __future__ import annotations

import argparse
import hashlib
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SUMS = "SHA256SUMS"
SIGNATURE = "SHA256SUMS.sig"
ALGORITHM = "ED25519"
"""Signature algorithm. It has short signatures and requires no selection of hash and padding."""
BUILDERS = (
    (".ci/check_wheel.py", "{folder}"),
    ("packaging/deb.py", "--arch", "amd64", "--out", "{folder}"),
    ("packaging/deb.py", "--arch", "arm64", "--out", "{folder}"),
    ("packaging/sbom.py", "--out", "{folder}"),
)
"""Programs, with arguments, that write the files of a release to a folder."""


class ReleaseError(Exception):
    """The release cannot be made; the message names the reason and the remedy."""


def main() -> int:
    """Make the release, and print its folder; return 1 if the release cannot be made."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--key", type=Path, required=True, metavar="KEY.pem", help="Ed25519 key")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "release", metavar="DIR")
    given = parser.parse_args()
    try:
        print(make_release(given.key, given.out.resolve()))
    except ReleaseError as error:
        print(f"release: {error}", file=sys.stderr)
        return 1
    return 0


def make_release(key: Path, out: Path) -> Path:
    """Build and sign the release of this commit; return its folder in `out`.

    Raises
    ------
    ReleaseError
        The key is not an Ed25519 key, the checkout differs from its commit, the folder exists, or a
        build failed.
    """
    # These checks are fast and precede the builds, which take minutes.
    check_key(key)
    _check_checkout()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    folder = out / f"jointfitd-{project['version']}"
    if folder.exists():
        raise ReleaseError(f"{folder} exists: remove it, or raise the version in pyproject.toml")

    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="unfinished-", dir=out) as scratch:
        unfinished = Path(scratch) / folder.name
        unfinished.mkdir()
        for script, *arguments in BUILDERS:
            words = [word.format(folder=unfinished) for word in arguments]
            _run([sys.executable, ROOT / script, *words])
        sign_release(unfinished, key)
        unfinished.rename(folder)
    return folder


def check_key(key: Path) -> None:
    """Raise `ReleaseError` if `key` is not the file of a private Ed25519 key."""
    if shutil.which("openssl") is None:
        raise ReleaseError("openssl is not installed (Debian: apt install openssl)")
    if not key.is_file():
        raise ReleaseError(
            f"{key} is not a file: make a key with openssl genpkey -algorithm ed25519 -out {key}"
        )
    if ALGORITHM not in _run(["openssl", "pkey", "-in", key, "-noout", "-text_pub"]).upper():
        raise ReleaseError(
            f"{key} is no Ed25519 key: make one with openssl genpkey -algorithm ed25519"
        )


def sign_release(folder: Path, key: Path) -> None:
    """Write the checksums of all files in `folder` and their signature; verify the signature.

    Raises
    ------
    ReleaseError
        The folder contains no file, or openssl failed.
    """
    files = sorted(path for path in folder.iterdir() if path.name not in {SUMS, SIGNATURE})
    if not files:
        raise ReleaseError(f"{folder} contains no file to sign")
    sums, signature = folder / SUMS, folder / SIGNATURE
    lines = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in files]
    sums.write_text("".join(lines), encoding="utf-8")

    _run(["openssl", "pkeyutl", "-sign", "-rawin", "-inkey", key, "-in", sums, "-out", signature])

    with tempfile.TemporaryDirectory(prefix="jointfitd-key-") as scratch:
        public = Path(scratch) / "public.pem"
        _run(["openssl", "pkey", "-in", key, "-pubout", "-out", public])
        _run([
            "openssl", "pkeyutl", "-verify", "-rawin", "-pubin", "-inkey", public,
            "-in", sums, "-sigfile", signature,
        ])  # fmt: skip


def _check_checkout() -> None:
    changed = _run(["git", "-C", ROOT, "status", "--porcelain"])
    if changed:
        raise ReleaseError(f"the checkout differs from its commit: commit or remove\n{changed}")


def _run(words: list[str | Path]) -> str:
    """Return the output of a command; raise `ReleaseError` with its error text if it fails."""
    done = subprocess.run(  # noqa: S603 - our own commands
        [str(word) for word in words], text=True, check=False, capture_output=True,
    )  # fmt: skip
    if done.returncode:
        raise ReleaseError(
            f"{done.stdout}{done.stderr}{Path(words[0]).name} {words[1]} ended with"
            f" {done.returncode}"
        )
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
