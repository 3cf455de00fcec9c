"""What everything stands on: errors, components, the registry, files, where work runs."""
