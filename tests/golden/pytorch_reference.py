"""One update of Dreamer (version 1) in plain PyTorch, written from the definitions alone.

It shares no code with the project: the thesis (section 3.1, equations 16 and 17) and the
docstrings of dreamer_jax say what is computed, and this file computes it again. Its numbers are
stored, so the tests need no PyTorch. To write them anew, with any Python that has torch and numpy:

    python tests/golden/pytorch_reference.py trace tests/golden

writes one `CASE.npz` per case: parameters, batches, noise, and what came of them, in float64 and
stored as float32. The same update in float32 can be timed on random data, beside the project's:

    python tests/golden/pytorch_reference.py time depth=8 deter=100 stoch=20 units=200 B=16 L=20

and on a card, with the products of matrices in TensorFloat-32 as JAX makes them there, or (tf32=0)
in whole float32:

    python tests/golden/pytorch_reference.py time device=cuda

Axis letters: B batch, L sequence length, H imagination horizon, N imagination starts, A action.
Parameters are a flat dict, named and laid out as the project's: kernels [inputs, outputs], those of
convolutions [k, k, inputs, outputs].
"""

import json
import math
import statistics
import sys
import time
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

GROUPS = {
    "model": ("encoder", "decoder", "dynamics", "reward", "termination"),
    "value": ("value",),
    "actor": ("actor",),
}
BETAS = (0.9, 0.999)
UPDATES = 3

NETWORK = {
    "image_size": 32,
    "encoder_depth": 2,
    "stochastic_size": 4,
    "deterministic_size": 8,
    "hidden_size": 7,
    "head_units": 9,
    "reward_layers": 2,
    "value_layers": 3,
    "actor_layers": 4,
    "termination": False,
    "termination_layers": 3,
    "minimum_std": 0.1,
}
LEARNING = {
    "batch_size": 2,
    "sequence_length": 5,
    "horizon": 6,
    "imagination_starts": None,
    "discount": 0.99,
    "return_lambda": 0.95,
    "free_nats": 0.2,
    "kl_scale": 1.0,
    "image_std": 1.0,
    "reward_std": 1.0,
    "termination_scale": 10.0,
    "model_learning_rate": 6e-4,
    "value_learning_rate": 8e-5,
    "actor_learning_rate": 8e-5,
    "entropy_scale": 0.0,
    "entropy_scale_end": None,
    "entropy_decay": 10_000,
    "gradient_norm": 100.0,
    "adam_epsilon": 1e-7,
}
CASES = {
    # The thesis's losses. So small a state has 0.25 to 0.4 nats to tell: hence the low floor.
    "thesis": {"network": NETWORK, "learning": LEARNING},
    # What the thesis leaves out. The divergence is below its floor in the first update only; all
    # three gradients are clipped.
    "options": {
        "network": NETWORK | {"termination": True, "minimum_std": 0.2},
        "learning": LEARNING
        | {
            "imagination_starts": 7,
            "free_nats": 0.3,
            "kl_scale": 0.3,
            "image_std": 0.5,
            "reward_std": 2.0,
            "entropy_scale": 0.1,
            "entropy_scale_end": 0.01,
            "entropy_decay": 4,
            "gradient_norm": 0.05,
        },
    },
}
ACTION_SIZE = 3


# Layers.


def dense(p, name, x):
    return F.linear(x, p[f"{name}/kernel"].T, p.get(f"{name}/bias"))


def head(p, name, layers, x):
    for i in range(layers):
        x = F.elu(dense(p, f"{name}/hidden_{i}", x))
    return dense(p, f"{name}/out", x)


def encode(p, image):
    """Images, 0 to 255, [n, size, size, 3] -> embeddings [n, E], pixels before channels."""
    x = (image / 255 - 0.5).movedim(-1, 1)
    for i in range({32: 3, 64: 4}[image.shape[-2]]):
        kernel = p[f"encoder/conv_{i}/kernel"].permute(3, 2, 0, 1)
        x = F.relu(F.conv2d(x, kernel, p[f"encoder/conv_{i}/bias"], stride=2))
    return x.movedim(1, -1).flatten(1)


def decode(p, features, layers):
    """Features [n, M] -> images about [-0.5, 0.5], [n, size, size, 3].

    Row i of a kernel adds to the pixel k - 1 - i rows below its window's first; PyTorch's adds to
    the one i rows below it.
    """
    x = dense(p, "decoder/dense", features)[:, :, None, None]
    for i in range(layers):
        kernel = p[f"decoder/deconv_{i}/kernel"].flip(0, 1).permute(2, 3, 0, 1)
        x = F.conv_transpose2d(x, kernel, p[f"decoder/deconv_{i}/bias"], stride=2)
        if i < layers - 1:
            x = F.relu(x)
    return x.movedim(1, -1)


# Latent dynamics. A state is (mean, std, stochastic, deterministic).


def recur(p, stochastic, deterministic, action):
    """The next deterministic part: a GRU whose reset gate comes after the recurrent product."""
    x = dense(p, "dynamics/stoch_in", stochastic) + action @ p["dynamics/action_in/kernel"]
    bias, recurrent_bias = p["dynamics/gru/bias"]
    given = F.elu(x) @ p["dynamics/gru/kernel"] + bias
    kept = deterministic @ p["dynamics/gru/recurrent_kernel"] + recurrent_bias
    (update, reset, candidate), recurrent = given.chunk(3, -1), kept.chunk(3, -1)
    update = torch.sigmoid(update + recurrent[0])
    reset = torch.sigmoid(reset + recurrent[1])
    candidate = torch.tanh(candidate + reset * recurrent[2])
    return update * deterministic + (1 - update) * candidate


def gaussian(p, name, x, minimum_std):
    x = dense(p, f"dynamics/{name}/out", F.elu(dense(p, f"dynamics/{name}/hidden", x)))
    mean, std = x.chunk(2, -1)
    return mean, F.softplus(std) + minimum_std


def observe(p, embedding, action, first, noise, minimum_std):
    """Posterior states, a list of four tensors [B, L, ...]; noise [L, B, S]."""
    length, batch, size = noise.shape
    stochastic = noise.new_zeros(batch, size)
    deterministic = noise.new_zeros(batch, p["dynamics/gru/recurrent_kernel"].shape[0])
    states = []
    for t in range(length):
        keep = 1 - first[:, t, None]
        deterministic = recur(p, stochastic * keep, deterministic * keep, action[:, t] * keep)
        joined = torch.cat([deterministic, embedding[:, t]], -1)
        mean, std = gaussian(p, "posterior", joined, minimum_std)
        stochastic = mean + std * noise[t]
        states.append((mean, std, stochastic, deterministic))
    return [torch.stack(each, 1) for each in zip(*states, strict=True)]


# The actor's distribution: the tanh of a Gaussian.


def before_tanh(outputs):
    mean, std = outputs.chunk(2, -1)
    return 5 * torch.tanh(mean / 5), F.softplus(std + math.log(math.exp(5) - 1)) + 1e-4


def log_density(mean, std, x):
    """Of the action tanh(x), where x is a sample of N(mean, std); summed over A.

    The slope of tanh is 1 / cosh².
    """
    normal = -0.5 * ((x - mean) / std) ** 2 - torch.log(std) - 0.5 * math.log(2 * math.pi)
    return (normal + 2 * torch.log(torch.cosh(x))).sum(-1)


# Losses.


def model_loss(p, case, batch, noise):
    network, learning = case["network"], case["learning"]
    shape = batch["reward"].shape
    embedding = encode(p, batch["image"].flatten(0, 1)).unflatten(0, shape)
    mean, std, stochastic, deterministic = observe(
        p, embedding, batch["action"], batch["first"], noise["posterior"], network["minimum_std"]
    )
    features = torch.cat([stochastic, deterministic], -1)

    layers = {32: 3, 64: 4}[network["image_size"]]
    image = decode(p, features.flatten(0, 1), layers).unflatten(0, shape)
    target = batch["image"] / 255 - 0.5
    image_loss = 0.5 * ((image - target) ** 2).sum((-3, -2, -1)).mean()
    reward = head(p, "reward", network["reward_layers"], features)[..., 0]
    reward_loss = 0.5 * ((reward - batch["reward"]) ** 2).mean()

    prior_mean, prior_std = gaussian(p, "prior", deterministic, network["minimum_std"])
    kl = torch.distributions.kl_divergence(
        torch.distributions.Normal(mean, std), torch.distributions.Normal(prior_mean, prior_std)
    )
    kl = kl.sum(-1).mean()
    loss = image_loss / learning["image_std"] ** 2 + reward_loss / learning["reward_std"] ** 2
    loss = loss + learning["kl_scale"] * kl.clamp(min=learning["free_nats"])
    values = {"image_loss": image_loss, "reward_loss": reward_loss, "kl": kl}
    if network["termination"]:
        logits = head(p, "termination", network["termination_layers"], features)[..., 0]
        target = learning["discount"] * (1 - batch["terminal"])
        termination_loss = F.binary_cross_entropy_with_logits(logits, target)
        loss = loss + learning["termination_scale"] * termination_loss
        values["termination_loss"] = termination_loss
    return loss, values | {"model_loss": loss}, (stochastic, deterministic)


def behaviour_losses(p, case, posterior, noise, updates):
    """The actor's loss and the value head's, from one imagined rollout."""
    network, learning = case["network"], case["learning"]
    stochastic, deterministic = (x.detach().flatten(0, 1) for x in posterior)
    if learning["imagination_starts"] is not None:
        chosen = noise["starts"][: learning["imagination_starts"]]
        stochastic, deterministic = stochastic[chosen], deterministic[chosen]

    # features[t] is the state in which action t was taken; the start is features[0].
    features, log_densities = [torch.cat([stochastic, deterministic], -1)], []
    for t in range(learning["horizon"]):
        outputs = head(p, "actor", network["actor_layers"], features[t].detach())
        mean, std = before_tanh(outputs)
        chosen = mean + std * noise["action"][t]
        log_densities.append(log_density(mean, std, chosen))
        deterministic = recur(p, stochastic, deterministic, torch.tanh(chosen))
        mean, std = gaussian(p, "prior", deterministic, network["minimum_std"])
        stochastic = mean + std * noise["prior"][t]
        features.append(torch.cat([stochastic, deterministic], -1))
    imagined = torch.stack(features[1:])

    reward = head(p, "reward", network["reward_layers"], imagined)[..., 0]
    value = head(p, "value", network["value_layers"], imagined)[..., 0]
    discount = torch.full_like(reward, learning["discount"])
    if network["termination"]:
        logits = head(p, "termination", network["termination_layers"], imagined)[..., 0]
        discount = torch.sigmoid(logits)

    # Equation 16, from the last state backwards; it only bootstraps.
    lambda_, following, returns = learning["return_lambda"], value[-1], []
    for t in reversed(range(learning["horizon"] - 1)):
        mixed = (1 - lambda_) * value[t + 1] + lambda_ * following
        following = reward[t] + discount[t] * mixed
        returns.insert(0, following)
    returns = torch.stack(returns)
    weights = [torch.ones_like(discount[0])]
    for t in range(learning["horizon"] - 2):
        weights.append(weights[-1] * discount[t].detach())
    weights = torch.stack(weights)

    # Equation 17.
    actor_loss = -(weights * returns).mean()
    entropy = -torch.stack(log_densities[:-1])
    actor_loss = actor_loss - entropy_scale(learning, updates) * (weights * entropy).mean()
    held = head(p, "value", network["value_layers"], imagined.detach())[:-1, ..., 0]
    value_loss = (weights * 0.5 * (held - returns.detach()) ** 2).mean()
    values = {
        "actor_loss": actor_loss,
        "value_loss": value_loss,
        "imagined_reward": reward.mean(),
        "imagined_value": value.mean(),
        "actor_entropy": entropy.mean(),
    }
    return actor_loss, value_loss, values


def entropy_scale(learning, updates):
    start, end = learning["entropy_scale"], learning["entropy_scale_end"]
    if end is None:
        return start
    return start + (end - start) * min(updates / learning["entropy_decay"], 1)


# The update.


def update(p, moments, case, batch, noise, updates):
    """One update: new parameters and moments, gradients before clipping, and values by name.

    Args:
      p: parameters by name.
      moments: Adam's first and second moments by name; the same names.
      case: settings of network and learning.
      batch: image, action, reward, first, terminal; leaves [B, L, ...].
      noise: "posterior" [L, B, S], "prior" [H, N, S], "action" [H, N, A], all standard normal,
        and "starts" [B * L], an order of the posterior states.
      updates: how many came before.
    """
    learning = case["learning"]
    p = {name: x.detach().requires_grad_() for name, x in p.items()}
    names = {
        group: [name for name in p if name.split("/")[0] in components]
        for group, components in GROUPS.items()
    }
    loss, values, posterior = model_loss(p, case, batch, noise)
    actor_loss, value_loss, behaviour_values = behaviour_losses(p, case, posterior, noise, updates)
    values = values | behaviour_values
    # The three graphs share what lies between the actor's actions and the value head.
    gradients = {
        group: torch.autograd.grad(loss, [p[name] for name in names[group]], retain_graph=True)
        for group, loss in (("model", loss), ("actor", actor_loss), ("value", value_loss))
    }

    new, new_moments, unclipped = {}, {}, {}
    for group, gradient in gradients.items():
        norm = torch.sqrt(sum((x**2).sum() for x in gradient))
        values[f"{group}_gradient_norm"] = norm
        scale = min(1.0, learning["gradient_norm"] / norm.item())
        for name, x in zip(names[group], gradient, strict=True):
            unclipped[name] = x
            new[name], new_moments[name] = adam(
                p[name].detach(),
                moments[name],
                scale * x,
                learning[f"{group}_learning_rate"],
                learning["adam_epsilon"],
                updates + 1,
            )
    values = {name: float(value.detach()) for name, value in values.items()}
    return new, new_moments, unclipped, values


def adam(x, moments, gradient, rate, epsilon, count):
    first = BETAS[0] * moments[0] + (1 - BETAS[0]) * gradient
    second = BETAS[1] * moments[1] + (1 - BETAS[1]) * gradient**2
    unbiased = first / (1 - BETAS[0] ** count), second / (1 - BETAS[1] ** count)
    return x - rate * unbiased[0] / (torch.sqrt(unbiased[1]) + epsilon), (first, second)


# Data.


def shapes(network, action_size):
    """Name -> shape of all parameters."""
    n = network
    features = n["stochastic_size"] + n["deterministic_size"]
    layers = {32: 3, 64: 4}[n["image_size"]]
    depth, hidden = n["encoder_depth"], n["hidden_size"]
    embedding = 4 * depth * 2 ** (layers - 1)
    found = {}

    def layer(name, *shape, bias=True):
        found[f"{name}/kernel"] = shape
        if bias:
            found[f"{name}/bias"] = shape[-1:]

    channels = [3] + [depth * 2**i for i in range(layers)]
    for i in range(layers):
        layer(f"encoder/conv_{i}", 4, 4, *channels[i : i + 2])
    channels = [embedding, *reversed(channels[1:-1]), 3]
    layer("decoder/dense", features, embedding)
    for i, k in enumerate({32: (5, 6, 6), 64: (5, 5, 6, 6)}[n["image_size"]]):
        layer(f"decoder/deconv_{i}", k, k, *channels[i : i + 2])
    layer("dynamics/stoch_in", n["stochastic_size"], hidden)
    layer("dynamics/action_in", action_size, hidden, bias=False)
    layer("dynamics/gru", hidden, 3 * n["deterministic_size"], bias=False)
    found["dynamics/gru/recurrent_kernel"] = (n["deterministic_size"], 3 * n["deterministic_size"])
    found["dynamics/gru/bias"] = (2, 3 * n["deterministic_size"])
    for name, inputs in (("prior", 0), ("posterior", embedding)):
        layer(f"dynamics/{name}/hidden", n["deterministic_size"] + inputs, hidden)
        layer(f"dynamics/{name}/out", hidden, 2 * n["stochastic_size"])
    heads = {"reward": 1, "value": 1, "actor": 2 * action_size}
    if n["termination"]:
        heads["termination"] = 1
    for name, outputs in heads.items():
        sizes = [features] + [n["head_units"]] * n[f"{name}_layers"]
        for i in range(n[f"{name}_layers"]):
            layer(f"{name}/hidden_{i}", *sizes[i : i + 2])
        layer(f"{name}/out", sizes[-1], outputs)
    return found


def draw_parameters(random, network, action_size):
    """Uniform within Glorot's limits, biases within 0.1, so that each of them has a part."""

    def one(name, shape):
        limit = 0.1
        if not name.endswith("/bias"):
            limit = math.sqrt(6 / (math.prod(shape[:-2]) * sum(shape[-2:])))
        return random.uniform(-limit, limit, shape)

    return {name: one(name, shape) for name, shape in shapes(network, action_size).items()}


def draw_batch(random, case, action_size):
    learning, size = case["learning"], case["network"]["image_size"]
    shape = (learning["batch_size"], learning["sequence_length"])
    first = random.random(shape) < 0.3
    return {
        "image": random.integers(0, 256, (*shape, size, size, 3)),
        "action": random.uniform(-1, 1, (*shape, action_size)),
        "reward": random.normal(size=shape),
        "first": first,
        "terminal": random.random(shape) < 0.3,
    }


def draw_noise(random, case, action_size):
    learning, size = case["learning"], case["network"]["stochastic_size"]
    batch, length = learning["batch_size"], learning["sequence_length"]
    states = batch * length
    imagined = (learning["horizon"], learning["imagination_starts"] or states)
    return {
        "posterior": random.normal(size=(length, batch, size)),
        "prior": random.normal(size=(*imagined, size)),
        "action": random.normal(size=(*imagined, action_size)),
        "starts": random.permutation(states),
    }


def stored(arrays):
    """Arrays as they are stored: float32, or the smallest other type."""
    kinds = {"image": np.uint8, "first": np.bool_, "terminal": np.bool_, "starts": np.int32}
    return {name: np.asarray(x, kinds.get(name, np.float32)) for name, x in arrays.items()}


def tensors(arrays, dtype):
    return {
        name: torch.as_tensor(x) if name == "starts" else torch.as_tensor(x).to(dtype)
        for name, x in arrays.items()
    }


# Commands.


def trace(case):
    """Everything about three updates of a case, as arrays by name."""
    random = np.random.default_rng(0)
    start = stored(draw_parameters(random, case["network"], ACTION_SIZE))
    found = {"settings": np.array(json.dumps(case | {"action_size": ACTION_SIZE}))}
    found |= {f"start/{name}": x for name, x in start.items()}
    p = tensors(start, torch.float64)
    moments = {name: (torch.zeros_like(x), torch.zeros_like(x)) for name, x in p.items()}
    for i in range(UPDATES):
        batch = stored(draw_batch(random, case, ACTION_SIZE))
        noise = stored(draw_noise(random, case, ACTION_SIZE))
        found |= {f"batch_{i}/{name}": x for name, x in batch.items()}
        found |= {f"noise_{i}/{name}": x for name, x in noise.items()}
        p, moments, gradients, values = update(
            p, moments, case, tensors(batch, torch.float64), tensors(noise, torch.float64), i
        )
        found |= {f"value_{i}/{name}": np.float64(value) for name, value in values.items()}
        if i == 0:
            found |= {f"gradient/{name}": x for name, x in stored(gradients).items()}
    return found | {f"end/{name}": x for name, x in stored(p).items()}


SIZES = {"depth": 32, "deter": 200, "stoch": 30, "units": 400, "B": 50, "L": 50, "H": 15, "A": 6}
DEFAULTS = SIZES | {"image": 64, "n": 5, "device": "cpu", "tf32": 1}


def timed(words):
    """Median seconds of an update on random data, in float32."""
    a = dict(DEFAULTS)
    for word in words:
        name, _, value = word.partition("=")
        if name not in a:
            sys.exit(f"unknown argument {name!r}: choose from {', '.join(a)}")
        a[name] = type(a[name])(value)
    device = torch.device(a["device"])
    if device.type == "cuda":
        if not torch.cuda.is_available():
            sys.exit(f"error: this PyTorch ({torch.__version__}) finds no CUDA device")
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = bool(a["tf32"])
    network = NETWORK | {
        "image_size": a["image"],
        "encoder_depth": a["depth"],
        "stochastic_size": a["stoch"],
        "deterministic_size": a["deter"],
        "hidden_size": a["deter"],
        "head_units": a["units"],
    }
    learning = LEARNING | {
        "batch_size": a["B"],
        "sequence_length": a["L"],
        "horizon": a["H"],
        "free_nats": 3.0,
    }
    case = {"network": network, "learning": learning}
    random = np.random.default_rng(0)
    drawn = draw_parameters(random, network, a["A"]), draw_batch(random, case, a["A"])
    p, batch = (
        {name: x.to(device) for name, x in tensors(stored(tree), torch.float32).items()}
        for tree in drawn
    )
    moments = {name: (torch.zeros_like(x), torch.zeros_like(x)) for name, x in p.items()}
    seconds = []
    for i in range(a["n"] + 1):
        started = time.perf_counter()
        size = {"posterior": (a["L"], a["B"], a["stoch"])}
        size |= {"prior": (a["H"], a["B"] * a["L"], a["stoch"])}
        size |= {"action": (a["H"], a["B"] * a["L"], a["A"])}
        noise = {name: torch.randn(shape, device=device) for name, shape in size.items()}
        p, moments, _, _ = update(p, moments, case, batch, noise, i)
        if device.type == "cuda":
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - started)
    # The first one allocates.
    median = statistics.median(seconds[1:])
    return {
        "benchmark": "pytorch",
        "torch": torch.__version__,
        "on": torch.cuda.get_device_name() if device.type == "cuda" else "cpu",
        "s_per_update": round(median, 5),
        **a,
    }


def main():
    match sys.argv[1:]:
        case ["trace", folder]:
            for name, case in CASES.items():
                np.savez_compressed(Path(folder) / f"{name}.npz", **trace(case))
        case ["time", *words]:
            print(json.dumps(timed(words)))
        case _:
            sys.exit(__doc__)


if __name__ == "__main__":
    main()
