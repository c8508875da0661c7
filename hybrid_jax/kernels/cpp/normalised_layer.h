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
  int64_t m, b, h, d;
  float epsilon;
  const float *gain, *shift, *w2;
  float *w1 = scratch(W1, h * m), *w1t = scratch(W1T, m * h), *bias = scratch(BIAS, D()), *w2t = scratch(W2T, h * D());
  float *hidden = scratch(HIDDEN, W * b), *active = scratch(ACTIVE, W * b);

  int64_t D() const { return (d + V - 1) / V * V; }  // numbers of an output in whole vectors
  int64_t rest() const { return m % V <= FEW ? m % V : 0; }  // inputs whose derivative is summed within vectors
  int64_t M() const { return (m - rest() + V - 1) / V * V; }  // numbers of the others in whole vectors

  Layer(int64_t m, int64_t b, int64_t h, int64_t d, float epsilon, const float* weight_in, const float* gain,
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
