"""The classifier is one of scikit-learn's, and its probabilities are the net's."""

import pickle
import warnings

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import EvidenceError, ModelError

pytest.importorskip(
    "sklearn", reason="scikit-learn (the extra sklearn, or vision) is not installed"
)
from sklearn.base import clone  # noqa: E402
from sklearn.model_selection import GridSearchCV, cross_val_score  # noqa: E402
from sklearn.utils.estimator_checks import check_estimator  # noqa: E402

from bayesmc.sklearn import BayesNetClassifier  # noqa: E402


def clinic() -> bmc.BayesNet:
    net = bmc.BayesNet("clinic")
    net.table("smoke", [], [0.5, 0.5], ("no", "yes"))
    net.table("lung", ["smoke"], [[0.95, 0.05], [0.7, 0.3]], ("no", "yes"))
    net.table("xray", ["lung"], [[0.9, 0.1], [0.2, 0.8]], ("no", "yes"))
    return net


def patients(count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    drawn = {n: np.array(v.labels) for n, v in clinic().sample(count, rng=0).items()}
    return np.stack([drawn["smoke"], drawn["xray"]], axis=1).astype(object), drawn["lung"]


def test_every_check_of_scikit_learn() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = check_estimator(BayesNetClassifier())
    kinds = [check["status"] for check in found]
    assert kinds.count("passed") >= 50 and set(kinds) <= {"passed", "skipped"}
    skipped = [check["check_name"] for check in found if check["status"] == "skipped"]
    assert set(skipped) <= {"check_array_api_input"}  # it asks for a setting of the environment


def test_a_fault_is_found_by_the_checks() -> None:
    class Wrong(BayesNetClassifier):
        def predict(self, X):
            return np.zeros(len(X))

    with pytest.raises((AssertionError, ValueError)), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_estimator(Wrong())


def test_naive_bayes_is_that_of_counts() -> None:
    X, y = patients()
    found = BayesNetClassifier(counts=0.5).fit(X, y)
    shares = []
    for label in ("no", "yes"):
        rows = X[y == label]
        prior = ((y == label).sum() + 0.5) / (len(y) + 1.0)
        like = [((rows[:, k] == "yes").sum() + 0.5) / (len(rows) + 1.0) for k in (0, 1)]
        shares.append(prior * like[0] * (1 - like[1]))
    wanted = np.array(shares) / sum(shares)
    np.testing.assert_allclose(found.predict_proba([["yes", "no"]])[0], wanted, rtol=1e-6)
    assert found.classes_.tolist() == ["no", "yes"] and list(found.net_) == ["class", "x0", "x1"]


def test_a_net_with_missing_features_and_hidden_nodes() -> None:
    pd = pytest.importorskip("pandas")
    X, y = patients()
    frame = pd.DataFrame(X, columns=["smoke", "xray"])
    frame.loc[::3, "smoke"] = None
    found = BayesNetClassifier(clinic(), "lung").fit(frame.astype("category"), y)
    learned = bmc.fit(clinic(), {**frame.to_dict("list"), "lung": y}, counts=1.0)
    np.testing.assert_allclose(found.fit_["lung"], learned["lung"], atol=1e-6)
    asked = pd.DataFrame({"smoke": ["yes", None], "xray": ["yes", "no"]})
    for row, evidence in enumerate([{"smoke": "yes", "xray": "yes"}, {"xray": "no"}]):
        wanted = bmc.infer(found.net_, evidence).probabilities("lung")
        np.testing.assert_allclose(found.predict_proba(asked)[row], wanted)
    hidden = BayesNetClassifier(clinic(), "lung").fit(frame[["xray"]], y)
    assert hidden.predict_proba(asked[["xray"]]).shape == (2, 2)
    again = pickle.loads(pickle.dumps(found))
    np.testing.assert_array_equal(again.predict(asked), found.predict(asked))
    assert clone(found).get_params()["target"] == "lung"


def test_a_net_that_is_known() -> None:
    pd = pytest.importorskip("pandas")
    net = bmc.BayesNet()
    net.table("kind", [], [0.5, 0.5], ("a", "b"))
    net.add("x", lambda kind: bmc.Normal(np.where(kind == "a", 0.0, 2.0), 1.0))
    X = pd.DataFrame({"x": [0.0, 1.0, None]})
    found = BayesNetClassifier(net, "kind", learn=False).fit(X, ["a", "b", "b"])
    wanted = [1 / (1 + np.exp(-2.0)), 0.5, 0.5]
    np.testing.assert_allclose(found.predict_proba(X)[:, 0], wanted)
    with pytest.raises(ModelError, match="'x' is no table.*learn=False"):
        BayesNetClassifier(net, "kind").fit(X, ["a", "b", "b"])


def test_within_scikit_learn() -> None:
    rng = np.random.default_rng(1)
    y = rng.integers(3, size=150)
    X = rng.normal(size=(150, 4)) + y[:, None]
    X[rng.random(X.shape) < 0.1] = np.nan
    assert cross_val_score(BayesNetClassifier(), X, y, cv=3).mean() > 0.7
    search = GridSearchCV(BayesNetClassifier(), {"bins": [2, 6]}, cv=3).fit(X, y)
    assert search.best_score_ > 0.7


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda X, y: BayesNetClassifier(clinic(), "lungs").fit(X, y), "did you mean 'lung'"),
        (lambda X, y: BayesNetClassifier(clinic()).fit(X, y), "give the node of the net that is"),
        (lambda X, y: BayesNetClassifier(clinic(), "lung").fit(X[:, :1], y), "1 columns without"),
        (
            lambda X, y: BayesNetClassifier(clinic(), "lung").fit(X, np.char.upper(y)),
            "'NO', which is no state of 'lung' .did you mean 'no'",
        ),
        (lambda X, y: BayesNetClassifier(bins=1).fit(X, y), "bins=1.: give a whole number"),
        (lambda X, y: BayesNetClassifier("clinic", "lung").fit(X, y), "net is a str"),
    ],
)
def test_what_is_refused(make, words: str) -> None:
    with pytest.raises((ModelError, EvidenceError, ValueError), match=words):
        make(*patients(20))


def test_states_that_were_not_seen() -> None:
    X, y = patients(40)
    with pytest.raises(
        ValueError, match=r"unknown categories \['maybe'\] in column 0 \('x0'\).*'no', 'yes'"
    ):
        BayesNetClassifier().fit(X, y).predict([["maybe", "no"]])
    patient = BayesNetClassifier(handle_unknown="ignore").fit(X, y)
    unknown, missing = (
        patient.predict_proba([["maybe", "no"]]),
        patient.predict_proba([[None, "no"]]),
    )
    np.testing.assert_array_equal(unknown, missing)
    with pytest.raises(ValueError, match="handle_unknown='drop': give 'error' or 'ignore'"):
        BayesNetClassifier(handle_unknown="drop").fit(X, y)
    numbers = BayesNetClassifier().fit([[1.0], [2.0]], [0, 1])
    with pytest.raises(EvidenceError, match="feature 'x0' has 'a', and had numbers"):
        numbers.predict([["a"]])
