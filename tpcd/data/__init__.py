"""Episodes: the one format in which data comes in and goes out."""

from tpcd.data.checks import check_episode
from tpcd.data.episode import Episode
from tpcd.data.files import read_episode, write_episode

__all__ = ["Episode", "check_episode", "read_episode", "write_episode"]
