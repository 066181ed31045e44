#!/bin/sh
# Run a task of a CI job, on a server or on your own machine:
#
#   sh ci/pafot.sh install        install the requirements and pytest-pafot
#   sh ci/pafot.sh replay         replay the saved scenarios
#   sh ci/pafot.sh search         replay the saved scenarios, then search
#   sh ci/pafot.sh pull-request   search the commit BASE, then the change, which fails only because of new failures
#   sh ci/pafot.sh night          search with the date as the seed, and push the findings to a branch
#
# All other arguments are passed to pytest. Each session runs all tests, because tests that use pafot_simulate cannot be
# recognised before they run. The session writes pafot.json and pafot.xml, and pafot.html if a search or a replay ran.
#
# The script exits with pytest's exit code, or with 2 if it fails itself, for example because BASE cannot be tested. It
# also exits with 2 if pytest exits with 0 but pafot.json does not confirm this.
#
# These environment variables configure the script. An empty variable counts as unset.
#
#   REQUIREMENTS  the requirements file to install
#   RUNS, SEED    the number of runs and the seed of each search
#   LIMIT         the time limit of each search [s]
#   BASE          the commit before the change; failures that also occur there are accepted
#   BRANCH        the branch for findings; neither the default branch nor the current branch
#   REMOTE        the remote with this branch; the default is origin
#   GIT_NAME, GIT_EMAIL  the author of commits with findings
#
# The task pull-request searches BASE in a separate checkout, which contains no git-ignored files. If REQUIREMENTS is
# set, the packages that this file lists in BASE are installed into a separate environment. If the tests need your own
# package to be installed, list it in this file, too.
#
# The task night commits findings on top of the branch and never force-pushes. If HEAD and the branch have diverged, the
# commit also merges them. If both have changed a saved scenario, the branch's version is kept. If both have changed
# another file, HEAD is not merged.
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
  [ -f "$here/../setup.py" ] ||
    fail "expected pytest-pafot to be installed, received no package of this name. List it in your requirements file."
  python -m pip install "$here/.."
}

# Forward signals to pytest, so that it can stop its processes and write its report. Python runs in the background for
# this purpose: a shell handles a signal only after its foreground command has ended.
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

# Run Python and store its exit code in $ended. Python has its own process group, so that it receives Ctrl-C only once,
# from this script. It restores the default action of SIGINT, because a shell makes background processes ignore SIGINT.
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
    kill -0 "$child" 2>/dev/null || break # if it is still running, a signal interrupted `wait`
  done
  child=''
  [ -z "$signal" ] || exit $((128 + signal))
}

# If a policy calls os._exit(0), pytest also exits with 0, but pafot.json does not contain this exit code.
session() {
  case "$* ${PYTEST_ADDOPTS:-}" in
    *--pafot-json*) fail "expected no --pafot-json, because this script reads pafot.json. Copy that file instead." ;;
  esac
  rm -f pafot.json || fail "expected pafot.json to be a file that can be deleted, received an error. Move it elsewhere."
  run_python -m pytest --pafot-json=pafot.json --pafot-report=pafot.html --junitxml=pafot.xml "$@"
  [ "$ended" = 0 ] || return "$ended"
  told="no file"
  if [ -f pafot.json ]; then
    # -I, because this folder may contain a json.py.
    told=$(python -I -c 'import json; print(json.load(open("pafot.json", "rb"))["exit"])' 2>/dev/null) ||
      told="a file without an exit code"
  fi
  [ "$told" != 0 ] || return 0
  [ "$told" != None ] || told="null, which means that the session did not finish"
  echo "pafot.sh: pytest exited with 0: expected the exit code 0 in pafot.json, received $told." \
    "Does your policy or a test call os._exit(0) or sys.exit(0)? Raise an exception instead." >&2
  return 2
}

search() {
  [ -z "${LIMIT:-}" ] || set -- "--pafot-max-time=$LIMIT" "$@"
  [ -z "${SEED:-}" ] || set -- "--pafot-seed=$SEED" "$@"
  [ -z "${RUNS:-}" ] || set -- "--pafot-runs=$RUNS" "$@"
  session "$@"
}

# The seed is the date (UTC). Each night tries different scenarios, but a repetition on the same day uses the same ones.
night() {
  SEED=${SEED:-$(date -u +%Y%m%d)}
  search "$@"
}

# Run two ordinary sessions: first one with BASE, in a separate checkout, then one with the change.
pull_request() {
  [ -n "${BASE:-}" ] ||
    fail "expected the commit before the change as BASE, received none. Set BASE, for example to main."
  if ! git rev-parse -q --verify "$BASE^{commit}" >/dev/null 2>&1; then
    kind=$(git cat-file -t "$BASE" 2>/dev/null) ||
      fail "expected a commit in this repository as BASE, received $BASE. Correct BASE, or fetch the commit first."
    fail "expected a commit as BASE, received $BASE, which is a $kind. Name a commit instead."
  fi
  temp=$(cd "$(mktemp -d)" && pwd)
  trap 'git worktree remove --force "$temp/base" 2>/dev/null || true; rm -rf "$temp"' EXIT
  git worktree add -q --detach "$temp/base" "$BASE"
  there=$temp/base/$(git rev-parse --show-prefix)
  mkdir -p "$there" # BASE may not contain this folder yet
  run_python "$here/pull_request.py" "$there" "$@"
  return "$ended"
}

# Fetch the branch and store its commit in $tip, or an empty string if the remote does not have this branch. Error
# messages end with $1.
look() {
  expected="expected to read $BRANCH from the remote ${remote##*@}, received the error above."
  expected="$expected Check REMOTE and your access to it.${1:-}"
  refs=$(git ls-remote -q --symref -- "$remote" HEAD "refs/heads/$BRANCH") || fail "$expected"
  default=$(printf '%s\n' "$refs" | awk -F '\t' '/^ref: / && $2 == "HEAD" { print substr($1, 6) }')
  for taken in "$default" "$(git symbolic-ref -q HEAD || true)"; do
    # If the file system ignores case, both names can refer to the same file.
    [ "$(printf %s "$taken" | tr A-Z a-z)" != "$(printf %s "refs/heads/$BRANCH" | tr A-Z a-z)" ] ||
      fail "expected a branch for findings only as BRANCH, received $BRANCH, which is the default or current branch." \
        "Choose another name."
  done
  tip=
  if printf '%s\n' "$refs" | awk -F '\t' -v name="refs/heads/$BRANCH" '$2 == name { n = 1 } END { exit !n }'; then
    git fetch -q --no-tags --no-recurse-submodules -- "$remote" "+refs/heads/$BRANCH:$FINDS" || fail "$expected"
    tip=$(git rev-parse "$FINDS")
    # A shallow clone may lack the commit where the branch started.
    [ "$(git rev-parse --is-shallow-repository)" = false ] || git fetch -q --no-tags --unshallow -- "$remote" ||
      fail "$expected"
  fi
}

# Merge the second and the third tree, with the first tree as their base, and print the result. If both have changed a
# file, use the second tree's version. If one has removed a file that the other has changed, keep the changed file.
join() (
  export GIT_INDEX_FILE="$temp/join"
  cd "./$(git rev-parse --show-cdup)"
  git read-tree --empty
  git read-tree -i -m --aggressive "$1" "$2" "$3"
  git ls-files -u -- ':(exclude,glob)**/*.pafot.yaml' >"$temp/clash"
  # Each line contains a mode, a blob, a stage and a name. The last line for a name counts, so lines with stage 2, which
  # is the second tree, come last.
  git ls-files -u | LC_ALL=C sort -r -t ' ' -k 3 | LC_ALL=C sed -n 's/^\([^ ]* [^ ]*\) [23]/\1 0/p' |
    git update-index --replace --index-info
  git write-tree
)

# Merge HEAD and the branch into the tree $both. Findings will be added to $onto in a commit with $parents.
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
      # A merge with either version of these files would undo the changes in the other one.
      onto=$tip parents="-p $tip"
      echo "findings are added to $BRANCH without merging HEAD. Merge HEAD manually, because both changed these files:"
      cut -f 2- "$temp/clash" | sort -u
    fi
  fi
}

# Read names of files, and print the names of those whose content is in a commit and can therefore be overwritten. Each
# name ends with a NUL.
committed() {
  xargs -0 sh -c 'for file; do
    [ -f "$file" ] && [ ! -L "$file" ] && blob=$(git hash-object -- "$file") || continue
    seen=$(git log -m -1 --format=%h --find-object="$blob" '"$head $tip"' -- ":(literal)$file")
    [ -z "$seen" ] || printf "%s\0" "$file"
  done' committed
}

# Check out the branch's files without overwriting uncommitted changes. Print the tree of all known files. It includes
# files that were deleted on the branch but still exist here, so that they are not added to the branch again.
bring() (
  export GIT_INDEX_FILE="$temp/bring"
  git read-tree "$both"
  git diff-tree -r --name-only -z --relative --diff-filter=d "$head" "$both" -- "$@" >"$temp/names"
  committed <"$temp/names" | git checkout-index -f -u -z --stdin
  git checkout-index -z --stdin <"$temp/names" >&2 ||
    echo "pafot.sh: the files above keep your uncommitted changes, and $BRANCH keeps its own versions" >&2
  git ls-files -z -o --exclude-standard -- "$@" | committed | git update-index --add --replace -z --stdin
  git ls-files -z -m -- "$@" | git update-index --remove --replace -z --stdin
  git write-tree
)

# Commit the findings and push them to the branch, without changing the index or the checkout.
keep() {
  found=$(
    export GIT_INDEX_FILE="$temp/keep"
    git read-tree "$known" &&
      git ls-files -z -m -o --exclude-standard -- "$@" | git update-index --add --remove --replace -z --stdin &&
      git write-tree
  ) || fail "expected to add the findings in $PWD, received the error above. Fix its cause, and run this task again."
  what="findings were pushed to"
  [ "$found" != "$known" ] || what="all findings are already on"
  refused=0
  for _ in 1 2 3 4 5 6 7 8 9; do
    tree=$(join "$known" "$onto" "$found")
    if [ "$tree" = "$(git rev-parse "$onto^{tree}")" ]; then
      [ -n "$tip" ] && echo "all findings are already on $BRANCH" || echo "no findings to push"
      return
    fi
    commit=$(echo "Add findings of a search" | git -c user.name="${GIT_NAME:-pytest-pafot}" \
      -c user.email="${GIT_EMAIL:-pytest-pafot@localhost}" commit-tree "$tree" $parents)
    if git push -q --no-follow-tags --recurse-submodules=no -- "$remote" "$commit:refs/heads/$BRANCH"; then
      echo "$what $BRANCH"
      return
    fi
    was=$tip
    look " The findings are in $PWD." # someone else may have pushed in the meantime
    meet
    [ "$tip" != "$was" ] || refused=$((refused + 1))
    [ $refused -lt 2 ] ||
      fail "expected to push the findings in $PWD to $BRANCH, received an error twice." \
        "Allow the push, and run this task again."
  done
  fail "expected to push the findings in $PWD to $BRANCH, received nine errors because the branch kept changing." \
    "Run this task again."
}

# Check out the branch's files, run a task, push its findings to the branch, and return the task's exit code.
with_branch() {
  if [ -z "${BRANCH:-}" ]; then
    "$@"
    return
  fi
  case $BRANCH in
    -* | HEAD | refs/*) fail "expected a branch name as BRANCH, received $BRANCH. Use a name such as pafot-finds." ;;
  esac
  git check-ref-format "refs/heads/$BRANCH" ||
    fail "expected a valid branch name as BRANCH, received $BRANCH. Use a name such as pafot-finds."
  head=$(git rev-parse -q --verify HEAD) ||
    fail "expected a git repository with a commit in $PWD, received none. Run this task in a clone."
  remote=${REMOTE:-origin}
  temp=$(cd "$(mktemp -d)" && pwd)
  trap 'rm -rf "$temp"' EXIT
  look
  meet
  known=$(bring "$FILES")
  code=0
  "$@" || code=$?
  [ "$(git rev-parse HEAD)" = "$head" ] ||
    fail "expected HEAD not to change, received another commit. The findings are in $PWD. Run this task again."
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
