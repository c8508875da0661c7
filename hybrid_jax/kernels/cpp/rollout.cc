// The trajectories of a minibatch by RK4, and their derivative, in one call each way: `_forward` and `_backward` of
// fields.py.
//
//   ẋ = f_p(x, u) + f_d(x, u): a rigid body, or nothing, plus the layer of normalised_layer.h, of z = [x, u], or nothing.

#include "normalised_layer.h"
#include "rigid_body.h"
#include "rk4.h"

namespace {

struct Sizes {
  int64_t steps, d, r, b, h, m, lanes;
  Sizes(Array w1, Array x0, Array u)
      : steps(u.size(-3)), d(x0.size(-2)), r(u.size(-2)), b(x0.size(-1)), h(w1.size(-2)), m(w1.size(-1)),
        lanes(x0.count() / (d * b)) {}
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

  bool has_body() const { return constants.size > 0; }
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

// The arguments of both kernels; the results of the way back are the derivatives with respect to those up to u.
enum Argument { THETA, WEIGHT_IN, GAIN, SHIFT, WEIGHT_OUT, BIAS_OUT, X0, U, KEPT, D_STATES };

Layer layer_of(const Sizes& s, const Lane& lane) {
  return Layer(s.m, s.b, s.h, s.d, lane.call.numbers()[EPSILON], lane.argument(WEIGHT_IN), lane.argument(GAIN),
               lane.argument(SHIFT), lane.argument(WEIGHT_OUT));
}

Field field_of(const Sizes& s, const Lane& lane) {
  return {s, layer_of(s, lane), lane.argument(BIAS_OUT), lane.argument(THETA), lane.call.numbers().from(CONSTANTS)};
}

// Results: the states, and what is kept.
void rollout_forward_call(const Call& call) {
  const Sizes s(call.argument(WEIGHT_IN), call.argument(X0), call.argument(U));
  for (int64_t i = 0; i < s.lanes; ++i) {
    const Lane lane{call, i, s.lanes};
    forward_lane(field_of(s, lane), call.numbers()[DT], lane.argument(X0), lane.argument(U), lane.result(0),
                 lane.result(1));
  }
}

void rollout_backward_call(const Call& call) {
  const Sizes s(call.argument(WEIGHT_IN), call.argument(X0), call.argument(U));
  float* d_w1t = scratch(D_W1T, s.m * s.h);
  for (int64_t i = 0; i < s.lanes; ++i) {
    const Lane lane{call, i, s.lanes};
    const Field field = field_of(s, lane);
    const Gradients to{d_w1t, lane.result(GAIN), lane.result(SHIFT), lane.result(WEIGHT_OUT), lane.result(BIAS_OUT)};
    field.layer.clear(to), std::fill_n(lane.result(THETA), 3, 0.0f);
    backward_lane(field, call.numbers()[DT], lane.argument(U), lane.argument(KEPT), lane.argument(D_STATES), to,
                  lane.result(THETA), lane.result(X0), lane.result(U));
    field.layer.to_rows(d_w1t, lane.result(WEIGHT_IN));
  }
}

}  // namespace

HANDLER(rollout_forward)
HANDLER(rollout_backward)
