#!/bin/sh
# What the jobs of a CI do, on a laptop as in an action:
#
#   sh ci/pafot.sh install        what the tests need, and pytest-pafot
#   sh ci/pafot.sh replay         what is saved
#   sh ci/pafot.sh search         what is saved, then a search
#   sh ci/pafot.sh pull-request   what is saved, then a search for what a change breaks
#   sh ci/pafot.sh night          a search that goes on where the last one stopped; its finds go onto a branch
#   sh ci/pafot.sh merge          the finds of several machines into one corpus, and onto a branch
#
# Further arguments are options of pytest. Each session leaves pafot.json, pafot.html and pafot.xml, and ends with
# pytest's exit code. The environment says the rest; what is empty or not set is left out:
#
#   REQUIREMENTS  a file for `pip install -r`
#   RUNS, SEED    of each search
#   LIMIT         seconds for all searches of a session
#   POLICY        module:factory that a pull request may change, such as planner:Planner, with its file below this folder
#   BASE          the commit before the change
#   AGAINST       module:factory of another reference, in place of POLICY and BASE
#   STATE         the folder with the states of searches that go on
#   BRANCH        the branch for finds; REMOTE has it (origin)
#   MACHINES      the folder below this one with a folder for each machine (machines)
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

session() {
  python -m pytest -m pafot --pafot-json=pafot.json --pafot-report=pafot.html --junitxml=pafot.xml "$@"
}

search() {
  [ -z "${LIMIT:-}" ] || set -- "--pafot-total-time=$LIMIT" "$@"
  [ -z "${SEED:-}" ] || set -- "--pafot-seed=$SEED" "$@"
  [ -z "${RUNS:-}" ] || set -- "--pafot-runs=$RUNS" "$@"
  session "$@"
}

# The policy of before lies beside the one of now as long as the session lasts.
pull_request() {
  if [ -n "${AGAINST:-}" ]; then
    search "--pafot-against=$AGAINST" "$@"
    return
  fi
  [ -n "${POLICY:-}" ] && [ -n "${BASE:-}" ] || fail "expected POLICY and BASE, or AGAINST; see the head of this file"
  module=${POLICY%%:*}
  file=$(echo "$module" | tr . /).py
  before=${file%.py}_before.py
  [ -f "$file" ] || fail "expected the file of POLICY=$POLICY in $PWD, found no $file"
  [ ! -e "$before" ] || fail "expected no file $before, where the policy of $BASE goes; rename yours"
  git rev-parse -q --verify "$BASE^{commit}" >/dev/null || fail "expected the commit BASE=$BASE; fetch it first"
  if ! git cat-file -e "$BASE:./$file" 2>/dev/null; then
    echo "$file is new: each failure counts"
    search "$@"
    return
  fi
  trap 'rm -f "$before"' EXIT
  trap 'exit 130' INT TERM
  git show "$BASE:./$file" >"$before"
  search "--pafot-against=${module}_before:${POLICY#*:}" "$@"
}

# Files that the branch has gained since it left this commit: what is known there is not found again.
bring() {
  known=0
  git ls-remote -q --exit-code "${REMOTE:-origin}" "refs/heads/$BRANCH" >/dev/null || known=$?
  case $known in
    0) git fetch -q "${REMOTE:-origin}" "+refs/heads/$BRANCH:$FINDS" ;;
    2) git update-ref -d "$FINDS" && return ;;
    *) fail "expected the remote ${REMOTE:-origin} with the branch $BRANCH, or none of that name, received an error" ;;
  esac
  # Where it left lies beyond what a shallow clone has.
  [ "$(git rev-parse --is-shallow-repository)" = false ] || git fetch -q --unshallow "${REMOTE:-origin}"
  new=$(mktemp)
  git diff --name-only -z --diff-filter=A --relative "HEAD...$FINDS" -- "$FILES" >"$new"
  [ ! -s "$new" ] || git --literal-pathspecs restore --source="$FINDS" --pathspec-from-file="$new" --pathspec-file-nul
  rm -f "$new"
}

# A commit of the saved scenarios on the branch, beside an index and a checkout that stay as they are.
keep() {
  index=$(mktemp)
  tree=$(
    export GIT_INDEX_FILE="$index"
    git read-tree HEAD
    set -- "$FILES" ":(exclude)${MACHINES:-machines}"
    [ -z "$(git status --porcelain -uall -- "$@")" ] || git add -A -- "$@"
    git write-tree
  )
  rm -f "$index"
  if [ "$tree" = "$(git rev-parse "HEAD^{tree}")" ]; then
    echo "no finds to keep"
    return
  fi
  before=$(git rev-parse -q --verify "$FINDS" || true)
  if [ -n "$before" ] && [ "$tree" = "$(git rev-parse "$FINDS^{tree}")" ]; then
    echo "all finds are on $BRANCH"
  else
    commit=$(echo "Keep what searches have found" | git -c user.name="${GIT_NAME:-pytest-pafot}" \
      -c user.email="${GIT_EMAIL:-pytest-pafot@localhost}" commit-tree "$tree" -p HEAD)
    if ! git push -q --force-with-lease="refs/heads/$BRANCH:$before" "${REMOTE:-origin}" "$commit:refs/heads/$BRANCH"
    then
      [ "${1:-}" != again ] || fail "expected to push finds to $BRANCH, received an error twice; they lie in $PWD"
      bring # what somebody else has pushed meanwhile
      keep again
      return
    fi
    echo "finds are on $BRANCH"
  fi
}

# Runs a session between the two, and ends with its exit code.
with_branch() {
  if [ -z "${BRANCH:-}" ]; then
    "$@"
    return
  fi
  bring
  code=0
  "$@" || code=$?
  keep
  return $code
}

merge() {
  for folder in "${MACHINES:-machines}"/*/; do
    [ -d "$folder" ] || fail "expected a folder for each machine in ${MACHINES:-machines}, found none"
    set -- "$@" "--pafot-merge=$folder"
  done
  session "$@"
}

task=${1:-}
[ $# = 0 ] || shift
case $task in
  install) install ;;
  replay) session --pafot-generations=0 "$@" ;;
  search) search "$@" ;;
  pull-request) pull_request "$@" ;;
  night) with_branch search "--pafot-resume=${STATE:-pafot_state}" "$@" ;;
  merge) with_branch merge "$@" ;;
  *) fail "expected install, replay, search, pull-request, night or merge, received '$task'" ;;
esac
