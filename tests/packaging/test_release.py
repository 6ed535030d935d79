"""Releases: checksums and signature verify as documented, and any change of a file is noticed."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "packaging"))

import release  # noqa: E402 - a folder of programs, no package

pytestmark = pytest.mark.skipif(
    shutil.which("openssl") is None, reason="openssl is not installed (Debian: apt install openssl)"
)


def openssl(*words: str | Path) -> None:
    subprocess.run(["openssl", *map(str, words)], check=True, capture_output=True)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with two files of a release, beside a key and its public part."""
    openssl("genpkey", "-algorithm", "ed25519", "-out", tmp_path / "key.pem")
    public = tmp_path / "jointfitd-release.pem"
    openssl("pkey", "-in", tmp_path / "key.pem", "-pubout", "-out", public)
    made = tmp_path / "jointfitd-1.0"
    made.mkdir()
    (made / "jointfitd-1.0.tar.gz").write_bytes(b"source")
    (made / "jointfitd_1.0-1_amd64.deb").write_bytes(b"package")
    return made


def verified_as_documented(folder: Path) -> bool:
    """Return whether the commands of the page succeed in `folder`."""
    page = (ROOT / "docs" / "security.md").read_text(encoding="utf-8")
    section = page.partition("## Verify a release\n")[2]
    block = re.search(r"```sh\n(.*?)```", section, re.DOTALL)
    assert block is not None
    done = subprocess.run(["sh", "-ec", block[1]], cwd=folder, check=False, capture_output=True)
    return done.returncode == 0


def test_a_signed_release_is_verified_by_the_commands_of_the_page(folder: Path) -> None:
    release.sign_release(folder, folder.parent / "key.pem")
    assert verified_as_documented(folder)
    listed = (folder / "SHA256SUMS").read_text().splitlines()
    assert [line.split()[1] for line in listed] == sorted(
        path.name for path in folder.iterdir() if not path.name.startswith("SHA256SUMS")
    )


@pytest.mark.parametrize("name", ["jointfitd-1.0.tar.gz", "SHA256SUMS", "SHA256SUMS.sig"])
def test_a_changed_byte_in_any_file_is_noticed(folder: Path, name: str) -> None:
    release.sign_release(folder, folder.parent / "key.pem")
    content = bytearray((folder / name).read_bytes())
    content[0] ^= 1
    (folder / name).write_bytes(content)
    assert not verified_as_documented(folder)


def test_the_signature_of_another_key_is_refused(folder: Path) -> None:
    openssl("genpkey", "-algorithm", "ed25519", "-out", folder.parent / "other.pem")
    release.sign_release(folder, folder.parent / "other.pem")
    assert not verified_as_documented(folder)


def test_a_key_of_another_kind_and_a_missing_one_are_named_before_anything_is_built(
    folder: Path,
) -> None:
    rsa = folder.parent / "rsa.pem"
    openssl("genpkey", "-algorithm", "rsa", "-out", rsa)
    with pytest.raises(release.ReleaseError, match=r"rsa\.pem is no Ed25519 key"):
        release.make_release(rsa, folder.parent / "out")
    with pytest.raises(release.ReleaseError, match=r"absent\.pem is not a file: make a key with"):
        release.make_release(folder / "absent.pem", folder.parent / "out")
    assert not (folder.parent / "out").exists()


def test_a_failed_build_leaves_no_folder_and_a_good_one_a_signed_release(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key, out = folder.parent / "key.pem", folder.parent / "out"
    monkeypatch.setattr(release, "_check_checkout", lambda: None)
    writer = folder.parent / "writer.py"
    writer.write_text("import sys, pathlib; pathlib.Path(sys.argv[1], 'a.whl').write_text('x')\n")
    broken = folder.parent / "broken.py"
    broken.write_text("raise SystemExit('no compiler')\n")

    monkeypatch.setattr(release, "BUILDERS", ((str(writer), "{folder}"), (str(broken),)))
    with pytest.raises(release.ReleaseError, match="no compiler"):
        release.make_release(key, out)
    assert list(out.iterdir()) == []

    monkeypatch.setattr(release, "BUILDERS", ((str(writer), "{folder}"),))
    made = release.make_release(key, out)
    assert sorted(path.name for path in made.iterdir()) == ["SHA256SUMS", "SHA256SUMS.sig", "a.whl"]
    shutil.copy(folder.parent / "jointfitd-release.pem", out)
    assert verified_as_documented(made)
    with pytest.raises(release.ReleaseError, match=r"exists: remove it, or raise the version"):
        release.make_release(key, out)
