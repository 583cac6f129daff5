"""The subcommands of `fleet`, in files by what they are for."""
