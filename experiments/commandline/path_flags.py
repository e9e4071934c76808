"""absl flags that name a path, in which `~` is expanded."""

from absl import flags as absl_flags

from experiments.surroundings import paths

absl_flags.disclaim_key_flags()  # --help lists a flag with the module that defines it by this one


class _PathParser(absl_flags.ArgumentParser):
    syntactic_help = "a path"

    def parse(self, argument: str) -> str:
        return paths.expanded(argument)

    def flag_type(self) -> str:
        return "path"


def define_path(
    name: str, default: str | None, help: str, flag_values: absl_flags.FlagValues = absl_flags.FLAGS
) -> absl_flags.FlagHolder:
    """Defines a flag whose value is a path as text; empty stays empty."""
    return absl_flags.DEFINE(_PathParser(), name, default, help, flag_values=flag_values)
