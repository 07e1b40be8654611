"""The package's exceptions, one tree, so that one ``except NNodeError`` catches them all.

Every message says what was expected, what was found, where (file, row, option) and what to do.
"""

from __future__ import annotations


class NNodeError(Exception):
    """Root of every error that the package raises on purpose."""


class DataError(NNodeError):
    """A file or table does not hold what its format promises."""


class FaultError(DataError):
    """Measured sequences hold faults and ``data.faults=error`` was asked for."""


class DownloadError(DataError):
    """Public data could not be fetched, or what came is not what was published."""


class ConfigError(NNodeError):
    """An option is unknown, of the wrong type, or contradicts another one."""


class SimulationError(NNodeError):
    """A simulation left the range in which its numbers mean anything."""


class CheckpointError(NNodeError):
    """A checkpoint is missing, damaged or of another format."""


class StudyError(NNodeError):
    """Tasks of a study failed, or its worker processes cannot run; what is done is kept."""


class WriteError(NNodeError):
    """Nothing can be written, as where a disk is full; what was written before is kept."""


class FolderInUseError(NNodeError):
    """Another run works in the folder."""


class NotFittedError(NNodeError, ValueError, AttributeError):
    """An estimator is asked for what it has only after a fit."""
