#!/bin/sh
# What the jobs of a CI do, on a laptop as in an action:
#
#   sh ci/pafot.sh install        what the tests need, and pytest-pafot
#   sh ci/pafot.sh replay         what is saved
#   sh ci/pafot.sh search         what is saved, then a search
#   sh ci/pafot.sh pull-request   a search of the commit BASE, then one of the change, red only for what is new
#   sh ci/pafot.sh night          a search from a seed of its day; its finds go onto a branch
#
# Each session runs all tests: one that uses pafot_simulate looks like any other one before it runs.
# Further arguments are options of pytest, such as the folder of the tests. Each session leaves pafot.json and pafot.xml,
# and pafot.html if a search or a replay ran. It ends with pytest's exit code, or with 2 where pytest ends with 0 and
# pafot.json does not say so, and where BASE cannot be installed or run. The environment says the rest; what is empty or
# not set is left out:
#
#   REQUIREMENTS  a file for `pip install -r`
#   RUNS, SEED    of each search
#   LIMIT         seconds for each search
#   BASE          the commit before the change; what fails there, too, is accepted
#   BRANCH        the branch for finds, neither the default one nor that of HEAD; REMOTE has it (origin)
#   GIT_NAME, GIT_EMAIL  the author of the commit of finds
#
# A pull request searches BASE in a checkout of its own, in which git-ignored files are missing. With REQUIREMENTS, an
# environment of its own gets what that file of BASE names; so name there what the repository itself installs, too.
#
# Finds are a commit on top of the branch as it is then, and never a forced push. Where both HEAD and the branch have
# moved, the commit joins them. Of a saved scenario that both have changed, the text on the branch stays.
set -eu

here=$(dirname "$0")
FINDS=refs/pafot/finds
FILES=':(glob)**/*.pafot.yaml'

fail() {
  echo "pafot.sh: $*" >&2
  exit 2
}

install() {
  [ -z "${REQUIREMENTS:-}" ] || python -m pip install -r "$REQUIREMENTS"
  if python -c 'import pytest_pafot' 2>/dev/null; then
    return
  fi
  [ -f "$here/../setup.py" ] || fail "expected pytest-pafot among the requirements, found none; name it there"
  python -m pip install "$here/.."
}

# A signal that ends this script goes to pytest first, which ends what it has begun. A shell in the foreground of a command
# would receive it only after that command.
child='' signal=''
received() {
  signal=$1
  case $child in
    '') exit $((128 + signal)) ;;
    starting) ;;
    *) kill "-$2" "$child" 2>/dev/null || true ;;
  esac
}
trap 'received 1 HUP' HUP
trap 'received 2 INT' INT
trap 'received 15 TERM' TERM

# Python with some arguments; its exit code is in $ended. It has a group of its own, so that Ctrl-C reaches it once, from
# here. It allows SIGINT, which a shell ignores in the background.
run_python() {
  child=starting
  python -I -c 'import os, signal, sys
os.setpgid(0, 0)
signal.signal(signal.SIGINT, signal.SIG_DFL)
os.execvp("python", ["python", *sys.argv[1:]])' "$@" <&0 &
  child=$!
  [ -z "$signal" ] || kill "$child" || true
  while :; do
    ended=0
    wait "$child" || ended=$?
    kill -0 "$child" 2>/dev/null || break # else a signal has ended only the wait
  done
  child=''
  [ -z "$signal" ] || exit $((128 + signal))
}

# A policy that calls os._exit(0) ends pytest with 0 as well. But then no code, or another one, is in pafot.json.
session() {
  case "$* ${PYTEST_ADDOPTS:-}" in
    *--pafot-json*) fail "expected no --pafot-json: each session leaves pafot.json, which is read here; copy that file" ;;
  esac
  rm -f pafot.json || fail "expected to replace pafot.json, which is no file; move it away"
  run_python -m pytest --pafot-json=pafot.json --pafot-report=pafot.html --junitxml=pafot.xml "$@"
  [ "$ended" = 0 ] || return "$ended"
  told="no such file"
  if [ -f pafot.json ]; then
    # Isolated, since a json.py may lie here.
    told=$(python -I -c 'import json; print(json.load(open("pafot.json", "rb"))["exit"])' 2>/dev/null) ||
      told="no JSON of a session"
  fi
  [ "$told" != 0 ] || return 0
  [ "$told" != None ] || told="null, as of a session that has not come to its end"
  echo "pafot.sh: pytest ended with 0: expected 0 as exit in pafot.json, received $told. Likely your policy or a test" \
    "ends the process, as os._exit(0) and sys.exit(0) do: let it raise an error instead" >&2
  return 2
}

search() {
  [ -z "${LIMIT:-}" ] || set -- "--pafot-max-time=$LIMIT" "$@"
  [ -z "${SEED:-}" ] || set -- "--pafot-seed=$SEED" "$@"
  [ -z "${RUNS:-}" ] || set -- "--pafot-runs=$RUNS" "$@"
  session "$@"
}

# The seed is that of the day (UTC), so that each night searches other scenarios, and a second one the same.
night() {
  SEED=${SEED:-$(date -u +%Y%m%d)}
  search "$@"
}

# Two ordinary sessions: the first one is of BASE, in a checkout of its own.
pull_request() {
  [ -n "${BASE:-}" ] || fail "expected BASE; see the head of this file"
  if ! git rev-parse -q --verify "$BASE^{commit}" >/dev/null 2>&1; then
    kind=$(git cat-file -t "$BASE" 2>/dev/null) || fail "expected the commit BASE=$BASE; fetch it first"
    fail "expected a commit as BASE, received $BASE, a $kind; name the commit"
  fi
  temp=$(cd "$(mktemp -d)" && pwd)
  trap 'git worktree remove --force "$temp/base" 2>/dev/null || true; rm -rf "$temp"' EXIT
  git worktree add -q --detach "$temp/base" "$BASE"
  there=$temp/base/$(git rev-parse --show-prefix)
  mkdir -p "$there" # a folder that the change has added
  run_python "$here/pull_request.py" "$there" "$@"
  return "$ended"
}

# What the remote has as the branch now: its commit in $tip, which is empty where there is none. An error ends with $1.
look() {
  expected="expected the remote ${remote##*@} with the branch $BRANCH, or none of that name, received an error${1:-}"
  refs=$(git ls-remote -q --symref -- "$remote" HEAD "refs/heads/$BRANCH") || fail "$expected"
  default=$(printf '%s\n' "$refs" | awk -F '\t' '/^ref: / && $2 == "HEAD" { print substr($1, 6) }')
  for taken in "$default" "$(git symbolic-ref -q HEAD || true)"; do
    # Where the case of letters does not count, they may be one file.
    [ "$(printf %s "$taken" | tr A-Z a-z)" != "$(printf %s "refs/heads/$BRANCH" | tr A-Z a-z)" ] ||
      fail "expected as BRANCH one for finds alone, received $BRANCH, the default branch or that of HEAD; name another"
  done
  tip=
  if printf '%s\n' "$refs" | awk -F '\t' -v name="refs/heads/$BRANCH" '$2 == name { n = 1 } END { exit !n }'; then
    git fetch -q --no-tags --no-recurse-submodules -- "$remote" "+refs/heads/$BRANCH:$FINDS" || fail "$expected"
    tip=$(git rev-parse "$FINDS")
    # Where it left lies beyond what a shallow clone has.
    [ "$(git rev-parse --is-shallow-repository)" = false ] || git fetch -q --no-tags --unshallow -- "$remote" ||
      fail "$expected"
  fi
}

# Print the tree in which the second and the third tree have both changed the first. Of a file that both have changed it
# has the text of the second; one that only either of them has removed and the other changed stays.
join() (
  export GIT_INDEX_FILE="$temp/join"
  cd "./$(git rev-parse --show-cdup)"
  git read-tree --empty
  git read-tree -i -m --aggressive "$1" "$2" "$3"
  git ls-files -u -- ':(exclude,glob)**/*.pafot.yaml' >"$temp/clash"
  # Lines of mode, blob, stage and name. The last line of a name counts: stage 2, the text of the second.
  git ls-files -u | LC_ALL=C sort -r -t ' ' -k 3 | LC_ALL=C sed -n 's/^\([^ ]* [^ ]*\) [23]/\1 0/p' |
    git update-index --replace --index-info
  git write-tree
)

# HEAD and the branch together: their tree in $both; in $onto and $parents where finds go.
meet() {
  if [ -z "$tip" ] || git merge-base --is-ancestor "$tip" "$head"; then
    both=$head onto=$head parents="-p $head"
  elif git merge-base --is-ancestor "$head" "$tip"; then
    both=$tip onto=$tip parents="-p $tip"
  else
    left=$(git merge-base "$head" "$tip") || left=$(git hash-object -t tree /dev/null)
    both=$(join "$left" "$tip" "$head")
    onto=$both parents="-p $tip -p $head"
    if [ -s "$temp/clash" ]; then
      # A merge that takes the text of either would undo the work of the other.
      onto=$tip parents="-p $tip"
      echo "finds go onto $BRANCH alone: it needs a merge by hand with HEAD, where both have changed"
      cut -f 2- "$temp/clash" | sort -u
    fi
  fi
}

# Of files here, those whose text is in a commit: nothing is lost with them. Names come and go with a NUL each.
committed() {
  xargs -0 sh -c 'for file; do
    [ -f "$file" ] && [ ! -L "$file" ] && blob=$(git hash-object -- "$file") || continue
    seen=$(git log -m -1 --format=%h --find-object="$blob" '"$head $tip"' -- ":(literal)$file")
    [ -z "$seen" ] || printf "%s\0" "$file"
  done' committed
}

# Bring what the branch knows into the checkout, but not over a text that is in no commit. Print the tree of what is known:
# a file here that was deleted on the branch is, too, and does not go there again.
bring() (
  export GIT_INDEX_FILE="$temp/bring"
  git read-tree "$both"
  git diff-tree -r --name-only -z --relative --diff-filter=d "$head" "$both" -- "$@" >"$temp/names"
  committed <"$temp/names" | git checkout-index -f -u -z --stdin
  git checkout-index -z --stdin <"$temp/names" >&2 ||
    echo "pafot.sh: your texts of these stay here, and those of $BRANCH there" >&2
  git ls-files -z -o --exclude-standard -- "$@" | committed | git update-index --add --replace -z --stdin
  git ls-files -z -m -- "$@" | git update-index --remove --replace -z --stdin
  git write-tree
)

# A commit of the finds on the branch, with an index and a checkout that stay as they are.
keep() {
  found=$(
    export GIT_INDEX_FILE="$temp/keep"
    git read-tree "$known" &&
      git ls-files -z -m -o --exclude-standard -- "$@" | git update-index --add --remove --replace -z --stdin &&
      git write-tree
  ) || fail "expected files that git can add, received an error; finds lie in $PWD"
  what="finds are"
  [ "$found" != "$known" ] || what="all finds are"
  refused=0
  for _ in 1 2 3 4 5 6 7 8 9; do
    tree=$(join "$known" "$onto" "$found")
    if [ "$tree" = "$(git rev-parse "$onto^{tree}")" ]; then
      [ -n "$tip" ] && echo "all finds are on $BRANCH" || echo "no finds to keep"
      return
    fi
    commit=$(echo "Keep what searches have found" | git -c user.name="${GIT_NAME:-pytest-pafot}" \
      -c user.email="${GIT_EMAIL:-pytest-pafot@localhost}" commit-tree "$tree" $parents)
    if git push -q --no-follow-tags --recurse-submodules=no -- "$remote" "$commit:refs/heads/$BRANCH"; then
      echo "$what on $BRANCH"
      return
    fi
    was=$tip
    look "; finds lie in $PWD" # what somebody else has pushed meanwhile
    meet
    [ "$tip" != "$was" ] || refused=$((refused + 1))
    [ $refused -lt 2 ] ||
      fail "expected to push finds to $BRANCH, received an error twice; they lie in $PWD. Allow it, and do this again"
  done
  fail "expected to push finds to $BRANCH, which moved each of nine times; they lie in $PWD. Do this again"
}

# Runs a session between the two, and ends with its exit code.
with_branch() {
  if [ -z "${BRANCH:-}" ]; then
    "$@"
    return
  fi
  case $BRANCH in
    -* | HEAD | refs/*) fail "expected the name of a branch as BRANCH, such as pafot-finds, received $BRANCH" ;;
  esac
  git check-ref-format "refs/heads/$BRANCH" || fail "expected a name that git allows as BRANCH, received $BRANCH"
  head=$(git rev-parse -q --verify HEAD) || fail "expected a repository with a commit in $PWD, found none"
  remote=${REMOTE:-origin}
  temp=$(cd "$(mktemp -d)" && pwd)
  trap 'rm -rf "$temp"' EXIT
  look
  meet
  known=$(bring "$FILES")
  code=0
  "$@" || code=$?
  [ "$(git rev-parse HEAD)" = "$head" ] ||
    fail "expected HEAD as it was before the session; finds lie in $PWD. Do this again"
  keep "$FILES"
  return $code
}

task=${1:-}
[ $# = 0 ] || shift
case $task in
  install) install ;;
  replay) session --pafot-generations=0 "$@" ;;
  search) search "$@" ;;
  pull-request) pull_request "$@" ;;
  night) with_branch night "$@" ;;
  *) fail "expected install, replay, search, pull-request or night, received '$task'" ;;
esac
