# Sourced by the other scripts of this folder: makes the virtual environment .venv of this repository on first use.
#
# A set-up that ended well leaves a stamp, .venv/ready.<extra>, as its very last act. The stamp holds where the
# repository lies and a hash of what was installed from, so that an interrupted, outdated or moved set-up is done again.
# shellcheck shell=bash

repository=$(dirname -- "$(dirname -- "$(readlink -f -- "${BASH_SOURCE[0]}")")")
venv=$repository/.venv
log=$venv/set-up.log

# Compiled modules may always be kept here. Where this variable is set, as in many containers, every start would compile
# a thousand modules of torch and others again, for as long as it takes to load them.
unset PYTHONDONTWRITEBYTECODE

say() { printf 'gnrecon: %s\n' "$*" >&2; }

fail() {
    say "$*"
    exit 2
}

# The end of the log goes with the sentence: it holds the reason.
fail_with_log() {
    tail -n 30 -- "$log" >&2
    fail "$* (the end of $log is above)."
}

find_python() {
    local candidate
    for candidate in python3 python3.13 python3.12 python3.11; do
        if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            printf '%s\n' "$candidate"
            return
        fi
    done
    fail "Python 3.11 or newer is needed, and none of python3, python3.13, python3.12, python3.11 is one."
}

# What the stamp of the extra $1 must hold; `base` is the package without an extra.
stamp() {
    printf '%s\n%s\n' "$repository" \
        "$(cd -- "$repository" && printf '%s\n' "$1" | cat - setup.cfg pyproject.toml constraints.txt | sha256sum)"
}

is_ready() { [ -x "$venv/bin/python" ] && [ "$(cat -- "$venv/ready.$1" 2>/dev/null)" = "$(stamp "$1")" ]; }

# Prints the Debian packages that the Python $1 finds missing, in one line.
missing_packages() { "$1" -I "$repository/gnrecon/cli/system_packages.py" | paste -sd ' '; }

# Whether apt-get is there and may be used.
may_install() { command -v apt-get >/dev/null && { [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null; }; }

# Installs the Debian packages that are named.
apt_install() {
    local as_root=()
    [ "$(id -u)" = 0 ] || as_root=(sudo -n)
    # A failed update is no failure yet: the lists at hand may do.
    "${as_root[@]}" apt-get -q update >>"$log" 2>&1 </dev/null || true
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -q -o DPkg::Lock::Timeout=300 \
        install -y --no-install-recommends "$@" >>"$log" 2>&1 </dev/null
}

install_system_packages() {
    local packages
    packages=$(missing_packages "$1") || fail "$1 cannot run $repository/gnrecon/cli/system_packages.py."
    [ -n "$packages" ] || return 0
    command -v apt-get >/dev/null ||
        fail "The system packages $packages (named as in Debian) are missing, and there is no apt-get to install them."
    may_install || fail "System packages are missing; install them with: sudo apt-get install -y $packages"
    say "installing the system packages $packages"
    # shellcheck disable=SC2086  # a list of words
    apt_install $packages ||
        fail_with_log "System packages could not be installed by: sudo apt-get install -y $packages"
    packages=$(missing_packages "$1")
    [ -z "$packages" ] || fail "What $packages should bring is still missing after apt-get installed them."
}

# The tests look at the HTML page in a browser. Where there is none they are skipped, so a failure here is none.
install_browser() {
    local name
    for name in chromium chromium-browser google-chrome chrome; do
        ! command -v "$name" >/dev/null || return 0
    done
    may_install || return 0
    say "installing chromium, in which the tests look at the HTML page"
    apt_install chromium || say "chromium could not be installed; the tests that need a browser will be skipped"
}

make_environment() {
    local extra=$1 python target=.
    python=$(find_python) || exit 2
    [ "$extra" = base ] || target=".[$extra]"
    # What an interrupted set-up, a Python that has gone, or another place left behind cannot be trusted.
    if ! "$venv/bin/python" -c '' 2>/dev/null ||
        [ "$(head -qn 1 -- "$venv"/ready.* 2>/dev/null | sort -u)" != "$repository" ]; then
        rm -rf -- "$venv"
    fi
    { mkdir -p -- "$venv" && : >"$log"; } 2>/dev/null || fail "$venv cannot be made: $repository is not writable."
    rm -f -- "$venv"/ready.*
    install_system_packages "$python"
    [ "$extra" != test ] || install_browser
    say "setting up $venv (once, some minutes)"
    [ -x "$venv/bin/python" ] || "$python" -m venv -- "$venv" >>"$log" 2>&1 ||
        fail_with_log "No virtual environment could be made"
    # From the repository's folder, where pip looks for the files in its arguments. A release that would have to be
    # compiled, as fpsample's newest, gives way to an older one that is ready. Python compiles what it imports by itself,
    # and keeps it; to compile all modules of all packages here would take as long as to unpack them.
    (
        cd -- "$repository"
        "$venv/bin/python" -m pip install --no-input --disable-pip-version-check --progress-bar off \
            --prefer-binary --no-compile -c constraints.txt -e "$target"
    ) >>"$log" 2>&1 </dev/null || fail_with_log "Packages could not be installed"
    # An environment with an extra serves those who need none as well.
    stamp base >"$venv/ready.base"
    stamp "$extra" >"$venv/ready.$extra"
    say "the set-up is done"
}

# Makes .venv ready for the package with the extra $1 (`base`: none), where it is not.
set_up() {
    ! is_ready "$1" || return 0
    # In a subshell, so that its settings end with it; the lock on the repository's folder lets one set-up run at a time.
    (
        umask 022
        export LC_ALL=C PIP_USER=0
        unset PYTHONPATH PYTHONHOME
        flock -n 9 || { say "waiting for another set-up to end" && flock 9; }
        # Another call may have done it since.
        is_ready "$1" || make_environment "$1"
    ) 9<"$repository"
}
