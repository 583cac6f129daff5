"""Installs Chromium for the console's tests, if there is none: `make browser`."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

from tests.support.console import CHROMIUM_NAMES

APT = ["apt-get", "install", "--yes", "--no-install-recommends", "chromium"]


def main() -> None:
    """Install the distribution's package as root, else Playwright's download. After a failure, print the command."""
    if any(map(shutil.which, CHROMIUM_NAMES)):
        return
    with sync_playwright() as playwright:
        if Path(playwright.chromium.executable_path).exists():
            return
    may_install = shutil.which("apt-get") and os.geteuid() == 0
    command = APT if may_install else [sys.executable, "-m", "playwright", "install", "chromium"]
    print(f"No Chromium found: {' '.join(command)}")
    if subprocess.run(command, check=False).returncode != 0:
        sys.exit(f"No Chromium for the tests of `fleet console`. Install it, for example: sudo {' '.join(APT)}")


if __name__ == "__main__":
    main()
