"""A browser without a head, for tests of pages."""

import shutil
from contextlib import contextmanager

import pytest

DRIVER = "chromedriver"
BROWSER = "chromium"


@contextmanager
def browser(folder):
    """A browser of its own without a head; skips where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    if not (shutil.which(BROWSER) and shutil.which(DRIVER)):
        pytest.skip(f"{BROWSER} and {DRIVER} are not installed: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which(BROWSER)
    quiet = ("quic", "background-networking", "component-update", "sync", "gpu")
    for flag in ("--headless=new", "--no-sandbox", "--no-first-run", *(f"--disable-{name}" for name in quiet), f"--user-data-dir={folder}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which(DRIVER)))
    try:
        yield driver
    finally:
        driver.quit()
