// The trajectories of a minibatch by RK4, and their derivative, in one call each way: `_forward` and `_backward` of
// rollout_kernels.py.
//
//   ẋ = f_p(x, u) + f_d(x, u): a rigid body, or nothing, plus the layer of normalised_layer.h, of z = [x, u], or nothing.

#include "normalised_layer.h"
#include "rigid_body.h"
#include "rk4.h"

namespace {

struct Sizes : Lanes {
  int64_t steps, d, r, b, h, m;
  Sizes(const Array& w1, const Array& x0, const Array& u) {
    const auto weights = w1.dimensions(), state = x0.dimensions(), input = u.dimensions();
    h = weights[weights.size() - 2], m = weights[weights.size() - 1];
    d = state[state.size() - 2], b = state[state.size() - 1];
    steps = input[input.size() - 3], r = input[input.size() - 2];
    lanes = x0.element_count() / (d * b);
  }
  int64_t state() const { return d * b; }
  int64_t input() const { return r * b; }
  int64_t kept() const { return state() + (h ? m * b + h : 0); }  // of an evaluation, see `Kept`
};

// What an evaluation keeps for the way back: x, and with a network z̃ and 1 / √(mean (W₁ z̃)² + ε).
struct Kept {
  float *x, *centred, *inverse;
  Kept(const Sizes& s, float* all, int64_t evaluation)
      : x(all + evaluation * s.kept()), centred(x + s.state()), inverse(centred + s.m * s.b) {}
};

// The vector field of a lane.
struct Field {
  const Sizes& s;
  const Layer layer;
  const float *bias, *theta;
  Constants constants;

  bool has_body() const { return constants.size() > 0; }
  bool has_network() const { return s.h > 0; }

  // ẋ at kept.x, and the rest of what is kept.
  void forward(const Kept& kept, const float* u, float* slope) const {
    float* network = has_body() ? scratch(NETWORK, s.state()) : slope;
    if (has_network()) {
      centre(kept.x, kept.centred, s.d, s.b), centre(u, kept.centred + s.state(), s.r, s.b);
      layer.forward(kept.centred, bias, kept.inverse, network);
    } else {
      std::fill_n(network, s.state(), 0.0f);
    }
    if (has_body()) forward_columns(Body(theta, constants, kept.x, u, s.b), network, slope);
  }

  // Stores the derivative with respect to x; adds those with respect to u, θ_p and the weights.
  void backward(const Kept& kept, const float* u, const float* d_slope, Gradients to, float* d_theta, float* d_x,
                float* d_u) const {
    float *d_z = scratch(D_Z, s.m * s.b), *d_held = scratch(D_U, s.input());
    if (has_network()) layer.backward(kept.centred, kept.inverse, d_slope, to, d_z);
    if (has_body()) backward_columns(Body(theta, constants, kept.x, u, s.b), d_slope, d_x, d_held, d_theta);
    auto merge = [&](int64_t n, float* body, const float* network) {
      if (has_body() && has_network())
        for (int64_t i = 0; i < n; ++i) body[i] += network[i];
      else if (has_network())
        std::copy_n(network, n, body);
    };
    merge(s.state(), d_x, d_z), merge(s.input(), d_held, d_z + s.state());
    for (int64_t i = 0; i < s.input(); ++i) d_u[i] += d_held[i];
  }
};

void forward_lane(const Field& field, float dt, const float* x0, const float* u, float* states, float* all_kept) {
  const Sizes& s = field.s;
  for (int64_t t = 0; t < s.steps; ++t, x0 = states, states += s.state(), u += s.input()) {
    auto kept = [&](int stage) { return Kept(s, all_kept, t * STAGES + stage); };
    rk4_step(
        s.state(), Stages(dt), x0, states, [&](int stage) { return kept(stage).x; },
        [&](int stage, float* slope) { field.forward(kept(stage), u, slope); });
  }
}

// `d_x` becomes the derivative with respect to x0.
void backward_lane(const Field& field, float dt, const float* u, float* all_kept, const float* d_states, Gradients to,
                   float* d_theta, float* d_x, float* d_u) {
  const Sizes& s = field.s;
  const Stages stages(dt);
  float *d_next = scratch(D_NEXT, s.state()), *d_slope = scratch(D_SLOPE, s.state());
  float* d_point = scratch(D_POINT, s.state());
  std::fill_n(d_x, s.state(), 0.0f), std::fill_n(d_u, s.steps * s.input(), 0.0f);
  for (int64_t t = s.steps; t--;) {
    for (int64_t i = 0; i < s.state(); ++i) d_x[i] += d_states[t * s.state() + i];
    std::copy_n(d_x, s.state(), d_next);
    for (int stage = STAGES; stage--;) {
      for (int64_t i = 0; i < s.state(); ++i)
        d_slope[i] = stages.share[stage] * d_next[i] + (stage < STAGES - 1 ? stages.ahead[stage] * d_point[i] : 0);
      const Kept kept(s, all_kept, t * STAGES + stage);
      field.backward(kept, u + t * s.input(), d_slope, to, d_theta, d_point, d_u + t * s.input());
      for (int64_t i = 0; i < s.state(); ++i) d_x[i] += d_point[i];
    }
  }
}

ffi::Error forward_call(float dt, Constants constants, float epsilon, Array theta, Array w1, Array gain, Array shift,
                        Array w2, Array bias, Array x0, Array u, Result states, Result kept) {
  const Sizes s(w1, x0, u);
  for (int64_t i = 0; i < s.lanes; ++i) {
    const Layer layer(s.m, s.b, s.h, s.d, epsilon, s.of(w1, i), s.of(gain, i), s.of(shift, i), s.of(w2, i));
    const Field field{s, layer, s.of(bias, i), s.of(theta, i), constants};
    forward_lane(field, dt, s.of(x0, i), s.of(u, i), s.of(states, i), s.of(kept, i));
  }
  return ffi::Error::Success();
}

ffi::Error backward_call(float dt, Constants constants, Array theta, Array w1, Array gain, Array shift,
                         Array w2, Array bias, Array x0, Array u, Array kept, Array d_states, Result d_theta,
                         Result d_w1, Result d_gain, Result d_shift, Result d_w2, Result d_bias, Result d_x0,
                         Result d_u) {
  const Sizes s(w1, x0, u);
  float* d_w1t = scratch(D_W1T, s.m * s.h);
  for (int64_t i = 0; i < s.lanes; ++i) {
    const Layer layer(s.m, s.b, s.h, s.d, 0, s.of(w1, i), s.of(gain, i), s.of(shift, i), s.of(w2, i));
    const Field field{s, layer, s.of(bias, i), s.of(theta, i), constants};
    const Gradients to{d_w1t, s.of(d_gain, i), s.of(d_shift, i), s.of(d_w2, i), s.of(d_bias, i)};
    layer.clear(to), std::fill_n(s.of(d_theta, i), 3, 0.0f);
    backward_lane(field, dt, s.of(u, i), s.of(kept, i), s.of(d_states, i), to, s.of(d_theta, i), s.of(d_x0, i),
                  s.of(d_u, i));
    layer.to_rows(d_w1t, s.of(d_w1, i));
  }
  return ffi::Error::Success();
}

}  // namespace

#define EIGHT(KIND) .KIND<Array>().KIND<Array>().KIND<Array>().KIND<Array>() \
                    .KIND<Array>().KIND<Array>().KIND<Array>().KIND<Array>()
#define BOTH ffi::Ffi::Bind().Attr<float>("dt").Attr<Constants>("constants")
XLA_FFI_DEFINE_HANDLER_SYMBOL(rollout_forward, forward_call,
                              BOTH.Attr<float>("epsilon") EIGHT(Arg).Ret<Array>().Ret<Array>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(rollout_backward, backward_call, BOTH EIGHT(Arg).Arg<Array>().Arg<Array>() EIGHT(Ret));
