/* xROWSx */
#include "xla/ffi/api/c_api.h" /* of xVERSIONx */

XLA_FFI_Error *call(XLA_FFI_CallFrame *frame)
{
    const XLA_FFI_Buffer *x, *y;
    int64_t count = 1;
    int k;
    /* The type of extension_start has another name in later releases, so it is not named here. */
    if (frame->extension_start != NULL && frame->extension_start->type == XLA_FFI_Extension_Metadata) {
        XLA_FFI_Metadata *told = ((XLA_FFI_Metadata_Extension *)frame->extension_start)->metadata;
        told->api_version.major_version = XLA_FFI_API_MAJOR;
        told->api_version.minor_version = XLA_FFI_API_MINOR;
        return NULL;
    }
    if (frame->stage != XLA_FFI_ExecutionStage_EXECUTE)
        return NULL;
    x = frame->args.args[0];
    y = frame->rets.rets[0];
    for (k = 0; k < x->rank - 1; ++k)
        count *= x->dims[k];
    rows(x->data, y->data, count);
    return NULL;
}
