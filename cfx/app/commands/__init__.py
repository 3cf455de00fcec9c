"""The sub-commands of `cfx`, each an entry point of the group `cfx.commands`."""
