"""Where raw files come from: the published copies, another address, or a folder.

Every published file is pinned twice: by the commit of the repository that holds it and by its
SHA-256. A download is checked before it is moved into place, so that no partial or altered file
is ever opened.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from urllib.parse import quote

import pooch

from nnode.errors import DataError, DownloadError, suggestion

log = logging.getLogger(__name__)

#: Environment variable with a folder of raw files, used where no ``source`` is configured.
FOLDER_VARIABLE = "NNODE_DATA"

#: Host of the published files, addressed as OWNER/REPOSITORY/COMMIT/PATH.
HOST = "https://raw.githubusercontent.com"

#: Seconds without an answer after which a server counts as unreachable.
TIMEOUT = 30.0


@dataclass(frozen=True)
class Origin:
    """A folder of a public repository at one commit.

    Attributes:
        repository: OWNER/NAME on GitHub.
        commit: full commit hash.
        path: folder inside the repository, empty for its root.
        licence: licence and attribution that using the files asks for.
        files: SHA-256 by file name.
        folders: names of sub-folders in which a local copy may keep the files.
        places: path below ``path`` of files that have another name there.
    """

    repository: str
    commit: str
    path: str
    licence: str
    files: Mapping[str, str]
    folders: tuple[str, ...]
    places: Mapping[str, str] = field(default_factory=dict)

    def url(self, name: str) -> str:
        """Address of one file."""
        parts = [self.repository, self.commit, self.path, self.places.get(name, name)]
        return f"{HOST}/{quote('/'.join(part for part in parts if part))}"


def _sums(text: str) -> dict[str, str]:
    """Hash by file name, from the lines that ``sha256sum`` writes."""
    pairs = (line.split(maxsplit=1) for line in text.strip().splitlines())
    return {name: digest for digest, name in pairs}


#: The published data sets by name.
ORIGINS: Mapping[str, Origin] = MappingProxyType(
    {
        "esimas": Origin(
            repository="ctotzeck/NN-interaction",
            commit="e590862404af0bb240934126cf7bf1923334946d",
            path="",
            licence="GPL-3.0 repository; original recording: E. Kallo, A. Fazekas, S. Lamberty, "
            "M. Oeser, Microscopic traffic data obtained from videos recorded on a German "
            "motorway, Mendeley Data V1, 2019",
            folders=("esimas",),
            files=_sums("""
8e1302590060707aab5013def4a74dabad41235516ba3aa7d5604058fcad7847  sequence_data1-1_1.mat
8b9037159aa8d36517790ace2065902693de7f302599700c965b5ffe348a6c28  sequence_data1-1_2.mat
621d81524be21fc4bcff919500afc49c5698a13ae23a16837a44b6ef36b050e7  sequence_data2-1_1.mat
8d7e2813f7543233d07ae2f6d0c4b80b559aa71a63747dccc606c3dcb35453ee  sequence_data2-1_2.mat
40b8d2e1b8bc93cc50bd0d80a896c8099e61f7ead000057191e1c2f34922ea15  sequence_data3-1_1.mat
84160a8915d6ddb4556d0f0a33c0386fb65824e4397c1831b10e5f118ed95926  sequence_data3-1_2.mat
2011d7814758641ae86f90669386871fa4fa9d92e0f14fcd177e2cd1a4d6565f  sequence_data4-1_1.mat
67c28e5acba856fa836a5ee000b311a65054bff41fe518168fdfef7f40509842  sequence_data4-1_2.mat
71ae08b664ccfdfa7f4c169e8678cdb9e8b513243f6ca2b84110f899176c87dd  sequence_data5-1_1.mat
6397f8a2b6a5928d0740e309081769a905ae61d08f33afbf713832358df1f62e  sequence_data5-1_2.mat
f4d788df4af46214ea87b71731b1b1113b926a2f8080f605b1acd825dfed4b22  sequence_data_1-1_1.mat
9caadcc8080a52e31311330f7c9adb966d3e4dfcb66c2bd8574f7ca23b7d29bf  sequence_data_1-1_2.mat
a21987dc2b048c06c019dc49e004ab8c664639301e171c2a8b4f3b642571383b  sequence_data_2-1_1.mat
870c869bd0b9049ed7e028138db9761cc06f5939b1a66e7c8456e227a7d78535  sequence_data_2-1_2.mat
3b69f41fe09f37a310903cd1e565c4eeda70aae840b7c8fc528eccb32dc979dd  sequence_data_3-1_1.mat
595566b95ac7bca6616878aedc35ca5786d3a182618d141bc1c1487b05e70867  sequence_data_3-1_2.mat
53d40dab26e7a4f549ae8a71903007a64454054f70abb267915d8f1e1fbb2328  sequence_data_4-1_1.mat
fdd3e2071b55941ac149ff059f0ccca79567839fa9532196ca304c7089851231  sequence_data_4-1_2.mat
a137d7bfb2afe58826cf7962c6f38412fe2a381368051154d096f9f25c6711ca  sequence_data_5-1_1.mat
f771de65c10de3ce7d58ea4a03d55c62a49a3c91c32dd03d7be009f3bd670e7e  sequence_data_5-1_2.mat
"""),
        ),
        "juelich": Origin(
            repository="PedestrianDynamics/PedPy",
            commit="8179b4b39e7c1e09eeb6b7d0f4e41f66e98cd6e4",
            path="notebooks/demo-data/bi-directional",
            licence="Forschungszentrum Jülich, reported as CC BY 4.0: attribute "
            "DOI 10.34735/ped.2013.5",
            folders=("juelich", "hermes"),
            files=_sums("""
e7c2b70c231f206897439187e8ad0255ebd10605fd311401102801b686c7d463  bi_corr_400_b_03.txt
"""),
        ),
        "hermes": Origin(
            repository="crowdbotp/OpenTraj",
            commit="97ec1d5e1b579f26febeaa9083705952deac338a",
            path="datasets/HERMES/Corridor-2D",
            licence="Forschungszentrum Jülich, project HERMES, 2009: attribute the archive "
            "ped.fz-juelich.de",
            folders=("hermes", "juelich"),
            files=_sums("""
2204d4717d6be01f5ee4dbe65dd67d88ef71e5eb3024fa1998037fe9ff8e9081  bo-360-050-050.txt
41f960a0f7b4178c133bc7af9c709be9b3412072d797e6d7850e49d1ed55d485  bo-360-090-090.txt
b63e1b201138a1f64bda574d23b8ef4ef1da02e1823ce54de9d4bd5f849dbe68  boa-300-065-105.txt
c7d8c33d2e9948d6a3eb35e270a92738712979e586ab2b6add5d13769528c352  boa-300-frei.txt
56dbeee898f062a00463f54188c1ef5f986804cd2984abe85c96d596b57022f1  bot-300-075-075.txt
890764d1ee327340fc7e9b28e7f3d547c89f6b8c56c9908d46261bde9746f307  bot-300-100-100.txt
44b35fc50e6f55e6ffcffda33de7eca52bf1d2d705b38025613c6800dac8e4c8  bot-360-160-160.txt
"""),
        ),
        "openacc": Origin(
            repository="thibault-charlottin/ACC-platoon-fuel-consumption",
            commit="8781ec31a976113210a9809b98345c76594c3896",
            path="data/OpenACC_data",
            licence="European Commission, Joint Research Centre: attribute OpenACC (Makridis, "
            "Mattas, Anesiadou & Ciuffo 2021), whose terms stand in the JRC data catalogue, "
            "JRCDBT0001",
            folders=("openacc", "openacc/zalazone"),
            files=_sums("""
8071e7ecb00b90f8d488d23aae1bd35911c60be416ea8f16a758eb033fc1eeab  long_setting_dynamic_part16.csv
84b0e1c3fdeb14e1e9ae4e7ed133b99eabbdea5f17641904b04247731f38c590  long_setting_handling_part39.csv
5d6dab96f35ac9da3d623ba4a5d311fbf0accb25bab8e52bce495dec5236e04f  mixed_dynamic_part7.csv
d6a41ac1a315d6d73723cae3de2189d807e195d9a2495e40383f745b6b110d1d  no_ACC_handling_part40.csv
84f91a87fae5f00e65ce97002f7e3b967b5d4dcec073cc8f633c5975c78681ab  short_setting_dynamic_part14.csv
522a982c57987aca16f4b49c3edd4702428e97480cdf52b094efef0c6b2c1676  short_setting_dynamic_part21.csv
"""),
            places=MappingProxyType(
                {
                    "long_setting_dynamic_part16.csv": "long_setting/dynamic_part16.csv",
                    "long_setting_handling_part39.csv": "long_setting/handling_part39.csv",
                    "mixed_dynamic_part7.csv": "mixed/dynamic_part7.csv",
                    "no_ACC_handling_part40.csv": "no_ACC/handling_part40.csv",
                    "short_setting_dynamic_part14.csv": "short_setting/dynamic_part14.csv",
                    "short_setting_dynamic_part21.csv": "short_setting/dynamic_part21.csv",
                }
            ),
        ),
        # read from a copy of the folder: the hashes of its files are not known here
        "ngsim_pairs": Origin(
            repository="TeRyZh/Segment-based-Calibration-of-Car-Following-Dynamics",
            commit="89f4f0c2fc4bfe1d975c70c7ce681d080a16f19c",
            path="cf_ngsim_I80",
            licence="the repository states none; original data: U.S. Department of "
            "Transportation, doi 10.21949/1504477",
            folders=("ngsim_pairs",),
            files={},
        ),
        "tgsim": Origin(
            repository="usdot-fhwa-stol/"
            "To-21-426-modeling-HV-interactions-with-inconspicuous-ACC-equipped-vehicles",
            commit="bd31e5189d9abef08fb5f1c10b2ace022d9e828d",
            path="calibration code/Data",
            licence="Apache-2.0",
            folders=("tgsim",),
            files={},
        ),
    }
)

#: SHA-256 by data set and file name.
FILES: dict[str, dict[str, str]] = {name: dict(origin.files) for name, origin in ORIGINS.items()}


def locate(dataset: str, files: list[str], *, source: str | None, folder: Path) -> dict[str, Path]:
    """Paths of raw files, downloaded where they are not at hand.

    Args:
        dataset: name of the data set, such as a key of :data:`FILES`.
        files: plain file names.
        source: a folder (the files lie in it or in a sub-folder named like the data set), an
            ``http(s)://`` address to which file names are appended, or None for the folder
            that the environment variable ``NNODE_DATA`` names, or without it the published
            address.
        folder: where downloads are kept; a file that is there already and has the published
            hash is not fetched again. Created when something is downloaded.

    Returns:
        The path of every file, in the order of ``files``.

    Raises:
        DataError: a name that is no plain file name, a file that the local folder does not
            hold, or a file that has no published address.
        DownloadError: the server cannot be reached, refuses, breaks off, or sends something
            else than was published. No partial file remains.
    """
    for name in files:
        _check_name(name)
    if source is None:
        source = os.environ.get(FOLDER_VARIABLE) or None
    if source is None:
        return {name: _fetch_published(dataset, name, folder) for name in files}
    if source.startswith(("http://", "https://")):
        base = source.rstrip("/")
        return {name: _fetch(dataset, name, f"{base}/{quote(name)}", folder) for name in files}
    if "://" in source:
        raise DataError(
            f"data.source={source}: expected a folder or an address that starts with http:// or "
            "https://"
        )
    return {name: _find(dataset, name, Path(source).expanduser()) for name in files}


def sha256(path: Path) -> str:
    """SHA-256 of a file as a hexadecimal string, to be recorded with what was read from it."""
    return str(pooch.file_hash(str(path), alg="sha256"))


def _check_name(name: str) -> None:
    if not name or name in (".", "..") or any(sign in name for sign in ("/", "\\", "\0")):
        raise DataError(
            f"{name!r} is not the name of a file: expected a plain name without folders, such as "
            "'sequence_data1-1_1.mat'; the folder belongs into data.source"
        )


def _origin(dataset: str, name: str) -> Origin | None:
    """The origin that publishes ``name``, that of ``dataset`` first.

    Both corridor archives are read by one reader, which need not know who publishes a file.
    """
    origin = ORIGINS.get(dataset)
    if origin is not None and name in origin.files:
        return origin
    return next((o for o in ORIGINS.values() if name in o.files and dataset in o.folders), origin)


def _fetch_published(dataset: str, name: str, folder: Path) -> Path:
    origin = _origin(dataset, name)
    if origin is None:
        raise DataError(
            f"data set {dataset!r} has no published address (known: {', '.join(ORIGINS)}); set "
            f"data.source=FOLDER, or {FOLDER_VARIABLE}, to a folder that holds {name}"
        )
    if name not in origin.files:
        published = [n for o in ORIGINS.values() if dataset in o.folders for n in o.files]
        raise DataError(
            f"{name} is not among the published files of {dataset}"
            f"{suggestion(name, published)}; published: {', '.join(published)}; for a file of your "
            "own set data.source=FOLDER"
        )
    return _fetch(dataset, name, origin.url(name), folder)


def _fetch(dataset: str, name: str, url: str, folder: Path) -> Path:
    origin = _origin(dataset, name)
    expected = origin.files.get(name) if origin else None
    pooch.get_logger().setLevel(logging.WARNING)  # it would say the whole address
    log.info("fetching %s", name)
    try:
        path = pooch.retrieve(
            url,
            known_hash=f"sha256:{expected}" if expected else None,
            fname=name,
            path=str(folder),
            downloader=pooch.HTTPDownloader(timeout=TIMEOUT),
        )
    except ValueError:  # pooch's answer to a wrong hash
        reason = f"what came is not the published file (SHA-256 {str(expected)[:12]}…)"
    except OSError as error:  # every failure of the connection, the server or the disk
        reason = _reason(error)
    else:
        return Path(path)
    address, asked = url, ""
    if origin and expected:
        address = f"{origin.url(name)} ({origin.licence})"
        asked = "" if url == origin.url(name) else f" from data.source={url.rpartition('/')[0]}"
    raise DownloadError(
        f"{name} could not be fetched{asked}: {reason}; try again, or get it by other means from "
        f"{address} and set data.source=FOLDER or {FOLDER_VARIABLE} to the folder that holds it"
    )


#: What classes of errors of the connection mean; their own words repeat the address.
_REASONS = {
    "Timeout": f"no answer within {TIMEOUT:g} s",
    "ChunkedEncodingError": "the connection broke off",
    "ConnectionError": "the server cannot be reached",
}


def _reason(error: OSError) -> str:
    """Why a download failed, in one line without the address."""
    answer = getattr(error, "response", None)
    if answer is not None:
        return f"the server answered {answer.status_code} {answer.reason}"
    kinds = {kind.__name__ for kind in type(error).__mro__}
    words_of_kind = (words for kind, words in _REASONS.items() if kind in kinds)
    return next(words_of_kind, f"{type(error).__name__}: {' '.join(str(error).split())}")


def held(source: Path, dataset: str) -> dict[str, Path]:
    """Files of a folder and of its sub-folders of a data set, by name; the first one of a name."""
    below = [sub for o in ORIGINS.values() if dataset in o.folders for sub in o.folders]
    places = [source, *(source / sub for sub in dict.fromkeys((dataset, *below)))]
    files: dict[str, Path] = {}
    for path in (path for place in places if place.is_dir() for path in sorted(place.iterdir())):
        files.setdefault(path.name, path)
    return files


def _find(dataset: str, name: str, source: Path) -> Path:
    if not source.is_dir():
        raise DataError(f"data.source: there is no folder {source}; expected one that holds {name}")
    files = held(source, dataset)
    if name in files and files[name].is_file():
        origin = _origin(dataset, name)
        expected = origin.files.get(name) if origin else None
        if expected and sha256(files[name]) != expected:  # edited data is welcome
            log.warning(
                "%s differs from the published file of that name; taken as it is", files[name]
            )
        return files[name]
    listing = ", ".join([*files][:20]) + (f", ... ({len(files)} in all)" if len(files) > 20 else "")
    raise DataError(
        f"{name} is neither in {source} nor in its sub-folders of {dataset}"
        f"{suggestion(name, files.keys())}; it holds: {listing or 'nothing'}; name one of these "
        "files or set data.source to another folder"
    )
