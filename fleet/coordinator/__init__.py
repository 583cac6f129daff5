"""The coordinator process: it observes the fleet, asks the policy what to do, and commands the cars."""
