"""Named errors. Each says what was got, what was expected and what to do; the command line prints it and exits 2."""


class VelapError(Exception):
    """Base of every error that velap raises on purpose; its text is meant for the user."""


class ConfigError(VelapError, ValueError):
    """A config field is out of range, unknown or contradicts another."""


class UnknownTaskError(VelapError, KeyError):
    """No task, method, planner, encoder, reader or preset of that name is registered."""

    def __str__(self) -> str:
        return str(self.args[0]) if self.args else ""


class DatasetError(VelapError, ValueError):
    """A dataset cannot be read or does not hold what training needs."""


class ObservationError(VelapError, ValueError):
    """Frames, an observation or what starts an episode are not of the kind that an agent takes."""


class CheckpointError(VelapError, ValueError):
    """A checkpoint is unreadable, damaged, foreign or does not fit the model."""


class RecordError(VelapError, ValueError):
    """A record file is unreadable or mixes configs that do not belong together."""


class RenderError(VelapError, RuntimeError):
    """No OpenGL backend works here, or it draws black frames."""


class StorageError(VelapError, OSError):
    """Writing failed (disk full, no permission); nothing was left half-written."""


class TrainingError(VelapError, RuntimeError):
    """Training met a state that it cannot continue from (a loss became NaN, say)."""
