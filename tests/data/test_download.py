"""Raw files from the published address, another address, or a folder, on a local server."""

from __future__ import annotations

import hashlib
import logging
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from nnode.data import download
from nnode.errors import DataError, DownloadError

CONTENT = b"id frame x y z\n" * 100


class Handler(BaseHTTPRequestHandler):
    """Serves CONTENT under all names except those of the failures."""

    def do_GET(self) -> None:
        self.server.requests.append(self.path)  # type: ignore[attr-defined]
        name = self.path.rsplit("/", 1)[-1]
        if name == "missing.txt":
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(CONTENT)))
        self.end_headers()
        if name == "cut.txt":
            self.wfile.write(CONTENT[:100])
            self.wfile.flush()
            self.connection.shutdown(socket.SHUT_RDWR)
        elif name == "altered.txt":
            self.wfile.write(CONTENT[:-1] + b"!")
        else:
            self.wfile.write(CONTENT)

    def log_message(self, *args: object) -> None:
        """Log nothing."""


@pytest.fixture
def server() -> Iterator[ThreadingHTTPServer]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.requests = []  # type: ignore[attr-defined]
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture
def base(server: ThreadingHTTPServer) -> str:
    return f"http://127.0.0.1:{server.server_address[1]}"


@pytest.fixture(autouse=True)
def published(monkeypatch: pytest.MonkeyPatch) -> None:
    """A generated data set, independent of environment variables."""
    monkeypatch.delenv(download.FOLDER_VARIABLE, raising=False)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    digest = hashlib.sha256(CONTENT).hexdigest()
    names = ("good.txt", "with space.txt", "missing.txt", "cut.txt", "altered.txt")
    origin = download.Origin(
        repository="owner/name",
        commit="c0ffee",
        path="some folder/data",
        licence="attribute DOI 10.0/example",
        files=dict.fromkeys(names, digest),
        folders=("demo", "other"),
    )
    monkeypatch.setattr(download, "ORIGINS", {"demo": origin})


def test_published_address_has_a_commit(
    tmp_path: Path,
    base: str,
    server: ThreadingHTTPServer,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(download, "HOST", base)
    names = ["good.txt", "with space.txt"]
    paths = download.locate("demo", names, source=None, folder=tmp_path / "raw")
    assert list(paths) == names
    for name, path in paths.items():
        assert path == tmp_path / "raw" / name
        assert path.read_bytes() == CONTENT
    assert server.requests == [  # type: ignore[attr-defined]
        "/owner/name/c0ffee/some%20folder/data/good.txt",
        "/owner/name/c0ffee/some%20folder/data/with%20space.txt",
    ]


def test_existing_file_is_not_fetched(
    tmp_path: Path, base: str, server: ThreadingHTTPServer
) -> None:
    for _ in range(2):
        paths = download.locate("demo", ["good.txt"], source=base + "/", folder=tmp_path)
    assert paths["good.txt"].read_bytes() == CONTENT
    assert server.requests == ["/good.txt"]  # type: ignore[attr-defined]


def test_unknown_file_from_an_address(tmp_path: Path, base: str) -> None:
    paths = download.locate("demo", ["mine.txt"], source=f"{base}/a/b", folder=tmp_path)
    assert paths["mine.txt"].read_bytes() == CONTENT


@pytest.mark.parametrize("copy", [False, True])
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("missing.txt", "the server answered 404 Not Found"),
        ("altered.txt", "not the published file"),
        ("cut.txt", "the connection broke off"),
        ("good.txt", "the server cannot be reached"),
    ],
)
def test_failed_download(
    tmp_path: Path,
    base: str,
    name: str,
    message: str,
    copy: bool,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """The message is one line with the address once; no file is left."""
    if name == "good.txt":
        with socket.socket() as unused:  # no server listens at its port afterwards
            unused.bind(("127.0.0.1", 0))
            base = f"http://127.0.0.1:{unused.getsockname()[1]}"
    monkeypatch.setattr(download, "HOST", base)
    source = f"{base}/copy" if copy else None
    with pytest.raises(DownloadError, match=message) as error:
        download.locate("demo", [name], source=source, folder=tmp_path)
    text = str(error.value)
    origin = f" from data.source={source}" if copy else ""
    address = f"{base}/owner/name/c0ffee/some%20folder/data/{name}"
    assert text.startswith(f"{name} could not be fetched{origin}: ")
    assert text.count(address) == 1
    assert "attribute DOI 10.0/example" in text
    assert "set data.source=FOLDER or NNODE_DATA to the folder that holds it" in text
    # no other part of an address, and no second line
    remainder = text.replace(address, "").replace(origin, "") + capfd.readouterr().err
    assert not any(part in remainder for part in ("c0ffee", "127.0.0.1", "\n"))
    assert list(tmp_path.iterdir()) == []


def test_incomplete_download_without_a_known_hash(
    tmp_path: Path, base: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(download, "ORIGINS", {})
    with pytest.raises(DownloadError, match=r"cut\.txt could not be fetched"):
        download.locate("demo", ["cut.txt"], source=base, folder=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_damaged_copy_is_replaced(tmp_path: Path, base: str) -> None:
    (tmp_path / "good.txt").write_bytes(CONTENT[:50])
    paths = download.locate("demo", ["good.txt"], source=base, folder=tmp_path)
    assert paths["good.txt"].read_bytes() == CONTENT


@pytest.mark.parametrize("sub", ["", "demo", "other"])
def test_folder_is_searched_with_its_subfolders(tmp_path: Path, sub: str) -> None:
    (tmp_path / sub).mkdir(exist_ok=True)
    (tmp_path / sub / "good.txt").write_bytes(CONTENT)
    paths = download.locate("demo", ["good.txt"], source=str(tmp_path), folder=tmp_path / "raw")
    assert paths == {"good.txt": tmp_path / sub / "good.txt"}
    assert not (tmp_path / "raw").exists()


def test_folder_from_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "good.txt").write_bytes(CONTENT)
    monkeypatch.setenv(download.FOLDER_VARIABLE, str(tmp_path))
    paths = download.locate("demo", ["good.txt"], source=None, folder=tmp_path / "raw")
    assert paths["good.txt"] == tmp_path / "good.txt"


def test_edited_local_file_is_used_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "good.txt"
    with caplog.at_level(logging.WARNING):
        path.write_bytes(CONTENT)
        download.locate("demo", ["good.txt"], source=str(tmp_path), folder=tmp_path)
        assert not caplog.records
        path.write_bytes(CONTENT + b"edited")
        paths = download.locate("demo", ["good.txt"], source=str(tmp_path), folder=tmp_path)
    assert paths["good.txt"] == path
    assert "differs from the published file" in caplog.text
    assert download.sha256(path) == hashlib.sha256(CONTENT + b"edited").hexdigest()


@pytest.mark.parametrize(
    ("data", "name", "source", "message"),
    [
        ("demo", "mine_04.txt", "{folder}", r"mine_04\.txt is neither in .*mean mine_03\.txt\?"),
        ("demo", "a.txt", "{folder}/no", "there is no folder"),
        ("demo", "god.txt", None, r"god\.txt is not among .*mean good\.txt\?"),
        ("mine", "a.txt", None, "'mine' has no published address"),
        ("demo", "good.txt", "ftp://host/x", "expected a folder or an address"),
    ],
)
def test_unknown_files_and_sources_are_refused(
    tmp_path: Path, data: str, name: str, source: str | None, message: str
) -> None:
    (tmp_path / "mine_03.txt").write_bytes(CONTENT)
    source = source and source.format(folder=tmp_path)
    with pytest.raises(DataError, match=message):
        download.locate(data, [name], source=source, folder=tmp_path)


@pytest.mark.parametrize(
    "name", ["../good.txt", "a/good.txt", "/etc/hosts", "..", ".", "", "a\\b.txt", "a\0.txt"]
)
@pytest.mark.parametrize("where", ["folder", "address", "published"])
def test_invalid_file_names_are_refused(tmp_path: Path, base: str, name: str, where: str) -> None:
    source = {"folder": str(tmp_path), "address": base, "published": None}[where]
    with pytest.raises(DataError, match="is not the name of a file"):
        download.locate("demo", [name], source=source, folder=tmp_path)


def test_file_of_another_folder_of_the_archive(
    tmp_path: Path, base: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(download, "HOST", base)
    paths = download.locate("other", ["good.txt"], source=None, folder=tmp_path)
    assert paths["good.txt"].read_bytes() == CONTENT


@pytest.mark.real
def test_published_hashes(real_data: Path) -> None:
    counts = {name: len(files) for name, files in download.FILES.items()}
    assert counts == {
        "esimas": 20,
        "juelich": 1,
        "hermes": 7,
        "openacc": 6,
        "ngsim_pairs": 0,
        "tgsim": 0,
    }
    folders = {"esimas": "esimas", "openacc": "openacc/zalazone"}
    for name, files in download.FILES.items():
        folder = real_data / folders.get(name, "juelich")
        for file, digest in files.items():
            assert hashlib.sha256((folder / file).read_bytes()).hexdigest() == digest
