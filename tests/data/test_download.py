"""Raw files from the published address, another one, or a folder; never from the internet."""

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

GOOD = b"id frame x y z\n" * 100


class Handler(BaseHTTPRequestHandler):
    """Serves GOOD under every name but those that misbehave."""

    def do_GET(self) -> None:
        self.server.requests.append(self.path)  # type: ignore[attr-defined]
        name = self.path.rsplit("/", 1)[-1]
        if name == "missing.txt":
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(GOOD)))
        self.end_headers()
        if name == "cut.txt":
            self.wfile.write(GOOD[:100])
            self.wfile.flush()
            self.connection.shutdown(socket.SHUT_RDWR)
        elif name == "altered.txt":
            self.wfile.write(GOOD[:-1] + b"!")
        else:
            self.wfile.write(GOOD)

    def log_message(self, *args: object) -> None:
        """Keep the output of the tests clean."""


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
    """A data set of our own making, and no influence from the environment."""
    monkeypatch.delenv(download.FOLDER_VARIABLE, raising=False)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    digest = hashlib.sha256(GOOD).hexdigest()
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


def test_the_published_address_is_pinned_to_a_commit(
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
        assert path.read_bytes() == GOOD
    assert server.requests == [  # type: ignore[attr-defined]
        "/owner/name/c0ffee/some%20folder/data/good.txt",
        "/owner/name/c0ffee/some%20folder/data/with%20space.txt",
    ]


def test_a_file_that_is_there_is_not_fetched_again(
    tmp_path: Path, base: str, server: ThreadingHTTPServer
) -> None:
    for _ in range(2):
        paths = download.locate("demo", ["good.txt"], source=base + "/", folder=tmp_path)
    assert paths["good.txt"].read_bytes() == GOOD
    assert server.requests == ["/good.txt"]  # type: ignore[attr-defined]


def test_a_file_of_unknown_name_may_come_from_an_address(tmp_path: Path, base: str) -> None:
    paths = download.locate("demo", ["mine.txt"], source=f"{base}/a/b", folder=tmp_path)
    assert paths["mine.txt"].read_bytes() == GOOD


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
def test_a_failure_is_one_line_with_the_address_once_and_leaves_no_file(
    tmp_path: Path,
    base: str,
    name: str,
    message: str,
    copy: bool,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    if name == "good.txt":
        with socket.socket() as probe:  # nothing listens at its port afterwards
            probe.bind(("127.0.0.1", 0))
            base = f"http://127.0.0.1:{probe.getsockname()[1]}"
    monkeypatch.setattr(download, "HOST", base)
    source = f"{base}/copy" if copy else None
    with pytest.raises(DownloadError, match=message) as caught:
        download.locate("demo", [name], source=source, folder=tmp_path)
    text = str(caught.value)
    asked = f" from data.source={source}" if copy else ""
    address = f"{base}/owner/name/c0ffee/some%20folder/data/{name}"
    assert text.startswith(f"{name} could not be fetched{asked}: ")
    assert text.count(address) == 1
    assert "attribute DOI 10.0/example" in text
    assert "set data.source=FOLDER or NNODE_DATA to the folder that holds it" in text
    # no other part of an address, and no second line
    remainder = text.replace(address, "").replace(asked, "") + capfd.readouterr().err
    assert not any(part in remainder for part in ("c0ffee", "127.0.0.1", "\n"))
    assert list(tmp_path.iterdir()) == []


def test_a_broken_connection_is_noticed_without_a_known_hash(
    tmp_path: Path, base: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(download, "ORIGINS", {})
    with pytest.raises(DownloadError, match=r"cut\.txt could not be fetched"):
        download.locate("demo", ["cut.txt"], source=base, folder=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_copy_is_replaced(tmp_path: Path, base: str) -> None:
    (tmp_path / "good.txt").write_bytes(GOOD[:50])
    paths = download.locate("demo", ["good.txt"], source=base, folder=tmp_path)
    assert paths["good.txt"].read_bytes() == GOOD


@pytest.mark.parametrize("sub", ["", "demo", "other"])
def test_a_folder_is_searched_with_its_sub_folders(tmp_path: Path, sub: str) -> None:
    (tmp_path / sub).mkdir(exist_ok=True)
    (tmp_path / sub / "good.txt").write_bytes(GOOD)
    paths = download.locate("demo", ["good.txt"], source=str(tmp_path), folder=tmp_path / "raw")
    assert paths == {"good.txt": tmp_path / sub / "good.txt"}
    assert not (tmp_path / "raw").exists()


def test_the_environment_names_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "good.txt").write_bytes(GOOD)
    monkeypatch.setenv(download.FOLDER_VARIABLE, str(tmp_path))
    paths = download.locate("demo", ["good.txt"], source=None, folder=tmp_path / "raw")
    assert paths["good.txt"] == tmp_path / "good.txt"


def test_an_edited_local_file_is_taken_and_mentioned(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "good.txt"
    with caplog.at_level(logging.WARNING):
        path.write_bytes(GOOD)
        download.locate("demo", ["good.txt"], source=str(tmp_path), folder=tmp_path)
        assert not caplog.records
        path.write_bytes(GOOD + b"edited")
        paths = download.locate("demo", ["good.txt"], source=str(tmp_path), folder=tmp_path)
    assert paths["good.txt"] == path
    assert "differs from the published file" in caplog.text
    assert download.sha256(path) == hashlib.sha256(GOOD + b"edited").hexdigest()


def test_a_missing_local_file_is_named_with_its_nearest_neighbour(tmp_path: Path) -> None:
    (tmp_path / "mine_03.txt").write_bytes(GOOD)
    with pytest.raises(DataError, match=r"mine_04\.txt is neither in .*mean mine_03\.txt\?"):
        download.locate("demo", ["mine_04.txt"], source=str(tmp_path), folder=tmp_path)
    with pytest.raises(DataError, match="there is no folder"):
        download.locate("demo", ["a.txt"], source=str(tmp_path / "no"), folder=tmp_path)


@pytest.mark.parametrize(
    "name", ["../good.txt", "a/good.txt", "/etc/hosts", "..", ".", "", "a\\b.txt", "a\0.txt"]
)
@pytest.mark.parametrize("where", ["folder", "address", "published"])
def test_names_that_lead_elsewhere_are_refused(
    tmp_path: Path, base: str, name: str, where: str
) -> None:
    source = {"folder": str(tmp_path), "address": base, "published": None}[where]
    with pytest.raises(DataError, match="is not the name of a file"):
        download.locate("demo", [name], source=source, folder=tmp_path)


def test_what_has_no_published_address_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"god\.txt is not among .*mean good\.txt\?"):
        download.locate("demo", ["god.txt"], source=None, folder=tmp_path)
    with pytest.raises(DataError, match="'mine' has no published address"):
        download.locate("mine", ["a.txt"], source=None, folder=tmp_path)
    with pytest.raises(DataError, match="expected a folder or an address"):
        download.locate("demo", ["good.txt"], source="ftp://host/x", folder=tmp_path)


def test_a_file_of_the_sister_archive_is_found_under_either_name(
    tmp_path: Path, base: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(download, "HOST", base)
    paths = download.locate("other", ["good.txt"], source=None, folder=tmp_path)
    assert paths["good.txt"].read_bytes() == GOOD


@pytest.mark.real
def test_the_published_hashes_are_those_of_the_recordings(real_data: Path) -> None:
    counts = {name: len(files) for name, files in download.FILES.items()}
    assert counts == {
        **{"esimas": 20, "juelich": 1, "hermes": 7},
        **{"openacc": 6, "ngsim_pairs": 0, "tgsim": 0},
    }
    for name, files in download.FILES.items():
        folder = real_data / {"esimas": "esimas", "openacc": "openacc/zalazone"}.get(
            name, "juelich"
        )
        for file, digest in files.items():
            assert hashlib.sha256((folder / file).read_bytes()).hexdigest() == digest
