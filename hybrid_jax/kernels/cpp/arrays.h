// What XLA hands to a kernel: arrays in single precision and, as one attribute, a list of numbers.
//
// By the interface in C, of which the caller in Python keeps to number, type and shape of the arrays. GCC takes longer
// for the interface in C++ than for the kernels.

#pragma once

#include <cstdint>

#include "xla/ffi/api/c_api.h"

namespace {

struct Array {
  const XLA_FFI_Buffer* buffer;
  float* data() const { return static_cast<float*>(buffer->data); }
  int64_t size(int64_t axis) const { return buffer->dims[buffer->rank + axis]; }  // the last axis is −1
  int64_t count() const {
    int64_t n = 1;
    for (int64_t i = 0; i < buffer->rank; ++i) n *= buffer->dims[i];
    return n;
  }
};

struct Call {
  const XLA_FFI_CallFrame* frame;
  Array argument(int64_t i) const { return {static_cast<const XLA_FFI_Buffer*>(frame->args.args[i])}; }
  Array result(int64_t i) const { return {static_cast<const XLA_FFI_Buffer*>(frame->rets.rets[i])}; }
  float number(int64_t i) const {
    return static_cast<const float*>(static_cast<const XLA_FFI_Array*>(frame->attrs.attrs[0])->data)[i];
  }
};

// Where the parts of a lane begin; the lanes of a sweep are the first axes of all arrays of a call.
struct LaneOf {
  const Call& call;
  int64_t lane, lanes;
  float* of(Array all) const { return all.data() + lane * (all.count() / lanes); }
  float* argument(int64_t i) const { return of(call.argument(i)); }
  float* result(int64_t i) const { return of(call.result(i)); }
};

// Whether XLA asks for no result, but for the version of the interface.
bool is_answered(const XLA_FFI_CallFrame* frame) {
  auto* asked = frame->extension_start;
  if (!asked || asked->type != XLA_FFI_Extension_Metadata) return false;
  XLA_FFI_Metadata* about = reinterpret_cast<XLA_FFI_Metadata_Extension*>(asked)->metadata;
  about->api_version = {XLA_FFI_Api_Version_STRUCT_SIZE, nullptr, XLA_FFI_API_MAJOR, XLA_FFI_API_MINOR};
  about->traits = 0;
  about->state_type_id = XLA_FFI_UNKNOWN_TYPE_ID;
  return true;
}

// A kernel of each lane; argument 1 is (…, D, b).
#define HANDLER(NAME)                                                                       \
  extern "C" XLA_FFI_Error* NAME(XLA_FFI_CallFrame* frame) {                                \
    if (is_answered(frame)) return nullptr;                                                 \
    const Call call{frame};                                                                 \
    const Array x0 = call.argument(1);                                                      \
    const int64_t lanes = x0.count() / (D * x0.size(-1));                                   \
    for (int64_t i = 0; i < lanes; ++i) NAME##_call({call, i, lanes});                      \
    return nullptr;                                                                         \
  }

}  // namespace
