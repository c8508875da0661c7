// One hidden layer with batch normalisation and ReLU on a minibatch, and its derivative.
//
//   y (d, b) = W₂ max(γ ĥ + β, 0) + b₂,  ĥ (h, b) = W₁ z̃ / √(mean (W₁ z̃)² + ε),  z̃ (m, b) = z less its row means.
//
// Hidden units lie along the vectors and samples along the rows, so that means over a minibatch need no sum within a
// vector, and W units are taken at a time: what they need stays in the first cache. h is a multiple of W, and b at least
// V, which the caller sees to, as to all shapes.

#pragma once

#include "products.h"

constexpr int64_t FEW = 4;  // inputs beyond whole vectors whose derivative is better summed within vectors

// Derivatives with respect to the weights, to which `Layer::backward` adds; W₁'s is transposed.
struct Gradients { float *w1t, *gain, *shift, *w2, *bias; };

// The layer of a lane.
struct Layer {
  int64_t m, b, B, h, d;  // B numbers lie in a row of b
  float epsilon;
  const float *gain, *shift, *w2;
  float *w1 = scratch(W1, h * m), *w1t = scratch(W1T, m * h), *bias = scratch(BIAS, D()), *w2t = scratch(W2T, h * D());
  float *hidden = scratch(HIDDEN, W * b), *active = scratch(ACTIVE, W * b);

  int64_t D() const { return (d + V - 1) / V * V; }  // numbers of an output in whole vectors
  int64_t rest() const { return m % V <= FEW ? m % V : 0; }  // inputs whose derivative is summed within vectors
  int64_t M() const { return (m - rest() + V - 1) / V * V; }  // numbers of the others in whole vectors

  Layer(int64_t m, int64_t b, int64_t B, int64_t h, int64_t d, float epsilon, const float* weight_in, const float* gain,
        const float* shift, const float* w2);

  // y from z̃, and 1 / √(mean (W₁ z̃)² + ε) for the way back.
  void forward(const float* centred, const float* bias_out, float* inverse, float* y) const;

  // The derivative with respect to z, and the gradients, from that with respect to y.
  void backward(const float* centred, const float* inverse, const float* d_y, Gradients to, float* d_z) const;

  void clear(Gradients to) const;
  void to_rows(const float* w1t, float* d_w1) const;  // W₁'s gradient as W₁ lies

 private:
  void units_forward(int64_t i, const float* centred, float* inverse, float* y) const;
  void units_backward(int64_t i, const float* centred, const float* inverse, const float* d_y, Gradients to,
                      float* d_zt, float* others) const;
};

Layer::Layer(int64_t m, int64_t b, int64_t B, int64_t h, int64_t d, float epsilon, const float* weight_in, const float* gain,
             const float* shift, const float* w2)
    : m(m), b(b), B(B), h(h), d(d), epsilon(epsilon), gain(gain), shift(shift), w2(w2) {
  std::memcpy(w1, weight_in, h * m * sizeof(float));
  transpose(w1, m, w1t, h, h, m);
  transpose(w2, h, w2t, D(), d, h);
}

void Layer::units_forward(int64_t i, const float* centred, float* inverse, float* y) const {
  const int64_t b = this->b, B = this->B, D = this->D();
  float* const hidden = this->hidden;
  Vec scale[N], move[N];
  strip<N>({centred, 1, B}, {w1t + i, h}, b, m, 0, [&](int64_t r, int64_t c, Vec v) { store(hidden + r * W + c, v); });
  for (int n = 0; n < N; ++n) {
    const Vec squares = over_rows(b, [&](int64_t j) { Vec v = load(hidden + j * W + n * V); return v * v; });
    const Vec root = inverse_root(squares / float(b) + epsilon);
    store(inverse + i + n * V, root);
    scale[n] = root * load(gain + i + n * V);
    move[n] = load(shift + i + n * V);
  }
  for (int64_t j = 0; j < b; ++j)
    for (int n = 0; n < N; ++n) {
      float* at = hidden + j * W + n * V;
      store(at, relu(scale[n] * load(at) + move[n]));
    }
  product({hidden, W, 1}, {w2t + i * D, D}, b, W, D, [&](int64_t r, int64_t c, Vec v) {
    float* at = y + r * D + c;
    store(at, v + (i ? load(at) : load(bias + c)));
  });
}

void Layer::units_backward(int64_t i, const float* centred, const float* inverse, const float* d_y, Gradients to,
                           float* d_zt, float* others) const {
  const int64_t m = this->m, b = this->b, B = this->B, h = this->h, M = this->M();
  float *const hidden = this->hidden, *const active = this->active;
  Vec scale[N], move[N], by_scale[N], by_shift[N];
  for (int n = 0; n < N; ++n) {
    scale[n] = load(inverse + i + n * V) * load(gain + i + n * V);
    move[n] = load(shift + i + n * V);
  }
  // The hidden units again: that takes less than to keep them for forty evaluations.
  strip<N>({centred, 1, B}, {w1t + i, h}, b, m, 0, [&](int64_t r, int64_t c, Vec v) {
    store(hidden + r * W + c, v);
    store(active + r * W + c, relu(scale[c / V] * v + move[c / V]));
  });
  strip<N>({d_y, B, 1}, {active, W}, d, b, 0, [&](int64_t r, int64_t c, Vec v) { add(to.w2 + r * h + i + c, v); });
  // From here `active` holds the derivative with respect to the units before the activation.
  strip<N>({d_y, 1, B}, {w2 + i, h}, b, d, 0, [&](int64_t r, int64_t c, Vec v) {
    float* at = active + r * W + c;
    store(at, load(at) > 0 ? v : Vec{});
  });
  for (int n = 0; n < N; ++n) {
    const Vec root = load(inverse + i + n * V);
    const float *before = hidden + n * V, *d_before = active + n * V;
    by_scale[n] = over_rows(b, [&](int64_t j) { return load(d_before + j * W) * load(before + j * W); });
    by_shift[n] = over_rows(b, [&](int64_t j) { return load(d_before + j * W); });
    add(to.gain + i + n * V, by_scale[n] * root);
    add(to.shift + i + n * V, by_shift[n]);
    // Through 1 / √(mean h² + ε); and less the mean, as ∂z is: that of h is zero.
    by_scale[n] *= -load(gain + i + n * V) * root * root * root / float(b);
    by_shift[n] *= scale[n] / float(b);
  }
  for (int64_t j = 0; j < b; ++j)
    for (int n = 0; n < N; ++n) {
      const int64_t at = j * W + n * V;
      store(active + at, scale[n] * load(active + at) + (by_scale[n] * load(hidden + at) - by_shift[n]));
    }
  strip<N>({centred, B, 1}, {active, W}, m, b, 0, [&](int64_t r, int64_t c, Vec v) { add(to.w1t + r * h + i + c, v); });
  product({active, W, 1}, {w1 + i * m, m}, b, W, M, [&](int64_t r, int64_t c, Vec v) {
    float* at = d_zt + r * M + c;
    store(at, i ? load(at) + v : v);
  });
  for (int64_t r = 0; r < rest(); ++r) {
    const float* row = w1t + (m - rest() + r) * h + i;
    for (int64_t j = 0; j < b; ++j) {
      float* at = others + (r * b + j) * V;
      Vec v = i ? load(at) : Vec{};
      for (int n = 0; n < N; ++n) v += load(active + j * W + n * V) * load(row + n * V);
      store(at, v);
    }
  }
}
void Layer::forward(const float* centred, const float* bias_out, float* inverse, float* y) const {
  float* rows = scratch(ROWS, b * D());
  std::memcpy(bias, bias_out, d * sizeof(float));
  for (int64_t i = 0; i < h; i += W) units_forward(i, centred, inverse, rows);
  transpose(rows, D(), y, B, b, d);
}

void Layer::backward(const float* centred, const float* inverse, const float* d_y, Gradients to, float* d_z) const {
  float *rows = scratch(ROWS, b * M()), *others = scratch(REST, rest() * b * V);
  for (int64_t i = 0; i < h; i += W) units_backward(i, centred, inverse, d_y, to, rows, others);
  for (int64_t r = 0; r < d; ++r) to.bias[r] += sum(d_y + r * B, b);
  transpose(rows, M(), d_z, B, b, m - rest());
  for (int64_t r = 0; r < rest(); ++r) sums(others + r * b * V, b, d_z + (m - rest() + r) * B);
}

void Layer::clear(Gradients to) const {
  std::fill_n(to.w1t, m * h, 0.0f), std::fill_n(to.w2, d * h, 0.0f), std::fill_n(to.bias, d, 0.0f);
  std::fill_n(to.gain, h, 0.0f), std::fill_n(to.shift, h, 0.0f);
}

void Layer::to_rows(const float* w1t, float* d_w1) const {
  float* rows = scratch(ROWS, h * m);
  transpose(w1t, h, rows, m, m, h);
  std::memcpy(d_w1, rows, h * m * sizeof(float));
}
