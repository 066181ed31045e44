#!/bin/sh
# What the jobs of a CI do, on a laptop as in an action:
#
#   sh ci/pafot.sh install        what the tests need, and pytest-pafot
#   sh ci/pafot.sh replay         what is saved
#   sh ci/pafot.sh search         what is saved, then a search
#   sh ci/pafot.sh pull-request   what is saved, then a search for what a change breaks
#   sh ci/pafot.sh night          a search that goes on where the last one stopped; its finds go onto a branch
#   sh ci/pafot.sh merge          the finds of several machines into one corpus, replayed, and onto a branch
#
# Each session runs all tests: one that calls pafot.sweep or uses pafot_simulate looks like any other one before it runs.
# Further arguments are options of pytest, such as the folder of the tests. Each session leaves pafot.json and pafot.xml,
# and pafot.html if a search or a replay ran. It ends with pytest's exit code, or with 2 where pytest ends with 0 and
# pafot.json does not say so, and where a pull request could not be compared. A finding of a
# pull request fails it only if the policy became worse, and not if that of before fails as often. The environment says the
# rest; what is empty or not set is left out:
#
#   REQUIREMENTS  a file for `pip install -r`
#   RUNS, SEED    of each search
#   LIMIT         seconds for all searches of a session
#   BASE          the commit before the change; the policy of each test is compared with that of this commit
#   AGAINST       another reference in place of BASE: rev:REVISION, or module:factory[:argument]
#   COPY          files and folders that the policy needs and git ignores, such as weights, with spaces between them
#   STATE         the folder with the states of searches that go on
#   BRANCH        the branch for finds, neither the default one nor that of HEAD; REMOTE has it (origin)
#   RESULTS       the folder on that branch for the pafot.json of each night (pafot_results)
#   GIT_NAME, GIT_EMAIL  the author of the commit of finds
#   MACHINES      the folder below this one with a folder for each machine (machines)
#
# Finds are a commit on top of the branch as it is then, and never a forced push. Where both HEAD and the branch have
# moved, the commit joins them. Of a saved scenario that both have changed, the text on the branch stays.
#
# The pafot.json of a night names its day (UTC) and its commit (HEAD), unless --pafot-today and --pafot-commit name others.
# If there is a BRANCH, the commit of finds has this file as RESULTS/DAY-COMMIT.json. It is made for this file alone if
# nothing was found. A second night of the same day and commit replaces the file.
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
  [ -z "${LIMIT:-}" ] || set -- "--pafot-total-time=$LIMIT" "$@"
  [ -z "${SEED:-}" ] || set -- "--pafot-seed=$SEED" "$@"
  [ -z "${RUNS:-}" ] || set -- "--pafot-runs=$RUNS" "$@"
  session "$@"
}

# The options of the day and the commit that a caller gives are arguments or in PYTEST_ADDOPTS, which pytest reads first.
night() {
  given="$* ${PYTEST_ADDOPTS:-}"
  tested=$(git rev-parse -q --verify HEAD 2>/dev/null) || tested=
  case $given in
    *--pafot-commit*) ;;
    *) [ -z "$tested" ] || set -- "--pafot-commit=$tested" "$@" ;;
  esac
  case $given in
    *--pafot-today*) ;;
    *) set -- "--pafot-today=$(date -u +%F)" "$@" ;;
  esac
  search "--pafot-resume=${STATE:-pafot_state}" "$@"
}

# The policy of before is built from all files of its commit, in a process of its own.
pull_request() {
  if [ -z "${AGAINST:-}" ]; then
    [ -n "${BASE:-}" ] || fail "expected BASE or AGAINST; see the head of this file"
    if ! git rev-parse -q --verify "$BASE^{commit}" >/dev/null 2>&1; then
      kind=$(git cat-file -t "$BASE" 2>/dev/null) || fail "expected the commit BASE=$BASE; fetch it first"
      fail "expected a commit as BASE, received $BASE, a $kind; name the commit"
    fi
    AGAINST=rev:$BASE
  fi
  [ -z "${COPY:-}" ] || set -- "--pafot-copy=$COPY" "$@"
  compared=0
  search "--pafot-against=$AGAINST" "$@" || compared=$?
  [ "$compared" != 4 ] || compared=2 # pytest's code for wrong use: there was nothing to compare with
  return "$compared"
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

# Print a tree with the blob $2 as the file $3. It is an error if that name, or a folder in it, is something else there.
with_file() (
  export GIT_INDEX_FILE="$temp/file"
  git read-tree "$1" &&
    git update-index --add --cacheinfo "100644,$2,$(git rev-parse --show-prefix)$3" &&
    git write-tree
)

not_filed() {
  record=
  echo "pafot.sh: pafot.json is not filed: expected $1, received $2" >&2
}

# Set $record to the name that pafot.json of a night gets on the branch, and $blob to its text; $record to nothing where it
# is not to be filed. A policy may have written the file, so its day and commit are checked before they become a name.
prepare_record() {
  record=
  [ "$task" = night ] || return 0
  if [ -L pafot.json ]; then
    received="a link"
  elif [ ! -e pafot.json ]; then
    received="no such file"
  elif [ ! -f pafot.json ]; then
    received="no regular file"
  elif [ "$(wc -c <pafot.json)" -gt 20000000 ]; then
    received="a larger one"
  elif name=$(python -I -c 'import json, re
session = json.load(open("pafot.json", "rb"))
(day,) = re.findall(r"\A\d{4}-\d\d-\d\d\Z", session["day"], re.ASCII)
print(day + "-" + re.sub(r"[^A-Za-z0-9._-]", "_", session["commit"][:7]))' 2>/dev/null); then
    record=$results/$name.json
    blob=$(git hash-object -w --path="$record" pafot.json) || not_filed "a file that git can add" "an error"
    return 0
  else
    received="no JSON of a session with its day and commit"
  fi
  not_filed "a file of at most 20 MB" "$received"
}

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
  prepare_record
  refused=0
  for _ in 1 2 3 4 5 6 7 8 9; do
    tree=$(join "$known" "$onto" "$found")
    if [ -n "$record" ]; then
      filed=$(with_file "$tree" "$blob" "$record") && tree=$filed ||
        not_filed "the folder $results, or none, on $BRANCH" "something else"
    fi
    if [ "$tree" = "$(git rev-parse "$onto^{tree}")" ]; then
      [ -n "$tip" ] && echo "all finds are on $BRANCH" || echo "no finds to keep"
      return
    fi
    commit=$(echo "Keep what searches have found" | git -c user.name="${GIT_NAME:-pytest-pafot}" \
      -c user.email="${GIT_EMAIL:-pytest-pafot@localhost}" commit-tree "$tree" $parents)
    if git push -q --no-follow-tags --recurse-submodules=no -- "$remote" "$commit:refs/heads/$BRANCH"; then
      echo "$what on $BRANCH${record:+, with pafot.json as $record}"
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
  others=":(exclude,literal)${MACHINES:-machines}"
  git ls-files -- "$FILES" "$others" >/dev/null || fail "expected MACHINES in the repository, received ${MACHINES:-machines}"
  temp=$(cd "$(mktemp -d)" && pwd)
  trap 'rm -rf "$temp"' EXIT
  look
  meet
  results=${RESULTS:-pafot_results}
  results=${results%/}
  with_file "$both" "$(git hash-object -w /dev/null)" "$results/day-commit.json" >/dev/null ||
    fail "expected as RESULTS the name of a folder below this one, received $results; name another"
  known=$(bring "$FILES" "$others")
  code=0
  "$@" || code=$?
  [ "$(git rev-parse HEAD)" = "$head" ] ||
    fail "expected HEAD as it was before the session; finds lie in $PWD. Do this again"
  keep "$FILES" "$others"
  return $code
}

add_machines() {
  for folder in "$machines"/*/; do
    [ -d "$folder" ] || fail "expected a folder for each machine in $machines, found none"
    set -- "$@" --from "$folder"
  done
  run_python -m pytest_pafot corpus join --write "$@"
}

# One of each kind stays only when a replay has said which of them fail here.
merge() {
  machines=${MACHINES:-machines} merged=0
  add_machines
  [ "$ended" = 0 ] || merged=$ended
  session --pafot-generations=0 "--ignore=$machines" "$@" || merged=$?
  run_python -m pytest_pafot corpus join --write --results pafot.json
  [ "$ended" = 0 ] || merged=$ended
  return "$merged"
}

task=${1:-}
[ $# = 0 ] || shift
case $task in
  install) install ;;
  replay) session --pafot-generations=0 "$@" ;;
  search) search "$@" ;;
  pull-request) pull_request "$@" ;;
  night) with_branch night "$@" ;;
  merge) with_branch merge "$@" ;;
  *) fail "expected install, replay, search, pull-request, night or merge, received '$task'" ;;
esac
