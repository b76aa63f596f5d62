"""Certificates for tests, made by openssl."""

import shutil
import subprocess
from pathlib import Path

import pytest


def openssl(folder: Path, *arguments: str) -> None:
    """Run openssl in a folder; where there is none, the test is skipped."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    subprocess.run(["openssl", *arguments], check=True, capture_output=True, cwd=folder)


def make_key(folder: Path, name: str) -> Path:
    openssl(folder, "ecparam", "-name", "prime256v1", "-genkey", "-noout", "-out", name)
    return folder / name


def make_authority(folder: Path, name: str) -> Path:
    """An authority's certificate, NAME.pem, beside its key."""
    make_key(folder, f"{name}-key.pem")
    openssl(
        folder, "req", "-x509", "-new", "-key", f"{name}-key.pem", "-out", f"{name}.pem", "-days", "2",
        "-subj", f"/CN={name}", "-addext", "keyUsage=critical,keyCertSign",
    )  # fmt: skip
    return folder / f"{name}.pem"


def make_certificate(folder: Path, authority: str, name: str, subject: str, *, days: int = 2) -> tuple[Path, Path]:
    """A server's certificate for a subject such as `IP:127.0.0.1`, signed by an authority; and its key."""
    key = make_key(folder, f"{name}-key.pem")
    openssl(folder, "req", "-new", "-key", key.name, "-out", f"{name}.csr", "-subj", f"/CN={name}")
    (folder / f"{name}.ext").write_text(f"subjectAltName={subject}\n")
    openssl(
        folder, "x509", "-req", "-in", f"{name}.csr", "-CA", f"{authority}.pem", "-CAkey", f"{authority}-key.pem",
        "-CAcreateserial", "-days", str(days), "-extfile", f"{name}.ext", "-out", f"{name}.pem",
    )  # fmt: skip
    return folder / f"{name}.pem", key
