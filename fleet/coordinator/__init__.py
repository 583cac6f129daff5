"""The coordinator process: `observer` takes samples in, `coordinator` runs the policy and commands the cars."""
