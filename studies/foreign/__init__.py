"""Problems from outside the package: a maze of another look, PushT, one more Meta-World task. README.md has the commands.

Each module stands alone and uses velap as a stranger would. None of them has settings of its own for training or planning.
"""
