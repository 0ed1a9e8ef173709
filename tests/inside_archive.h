/* SPDX-License-Identifier: MIT-0
   inside_archive.h - the safetensors reader and writer, and the numbers of its metadata */
#include "test.h"

#define LESSER(a, b) ((a) < (b) ? (a) : (b))
#define GREATER(a, b) ((a) > (b) ? (a) : (b))

/* ---- help -------------------------------------------------------------------------------------------------------- */

static dist_context *archive_context(test_allocator *a)
{
    dist_context_desc desc = test_context_desc();
    memset(a, 0, sizeof *a);
    desc.workers = 1;
    desc.allocator = test_allocator_hook(a);
    return dist_context_create(&desc);
}

/* A file of this header, written with ' for ", and data_size zero bytes of data, in a block of exactly its size; give
   it back with free. */
static unsigned char *archive_file(const char *header, size_t data_size, size_t *size)
{
    size_t length = strlen(header);
    unsigned char *bytes = (unsigned char *)calloc(1, 8 + length + data_size);
    for (size_t i = 0; bytes && i < 8; i++) bytes[i] = (unsigned char)((uint64_t)length >> 8 * i);
    for (size_t i = 0; bytes && i < length; i++) bytes[8 + i] = (unsigned char)(header[i] == '\'' ? '"' : header[i]);
    *size = 8 + length + data_size;
    return bytes;
}

static dist_status archive_open(dist_context *ctx, const char *header, size_t data_size, disti_archive *archive)
{
    size_t size;
    unsigned char *bytes = archive_file(header, data_size, &size);
    dist_status status = disti_archive_open(ctx, "dist_x", bytes, size, archive);
    free(bytes);
    return status;
}

/* Opening is refused with DIST_BAD_FILE and a sentence that begins with the function and contains `part`. */
static void archive_refused(const char *header, size_t data_size, const char *part)
{
    test_allocator a;
    dist_context *ctx = archive_context(&a);
    disti_archive archive;
    size_t before = a.live_blocks;
    CHECK_STATUS(DIST_BAD_FILE, archive_open(ctx, header, data_size, &archive), ctx);
    CHECK_STATUS(DIST_BAD_FILE, dist_context_status(ctx), ctx);
    CHECK(strncmp(dist_context_message(ctx), "dist_x: ", 8) == 0);
    CHECK_TEXT(part, dist_context_message(ctx));
    CHECK_EQUAL(before, a.live_blocks);
    disti_archive_close(ctx, &archive);
    dist_context_destroy(ctx);
}

static void archive_accepted(const char *header, size_t data_size)
{
    test_allocator a;
    dist_context *ctx = archive_context(&a);
    disti_archive archive;
    CHECK_STATUS(DIST_OK, archive_open(ctx, header, data_size, &archive), ctx);
    disti_archive_close(ctx, &archive);
    dist_context_destroy(ctx);
    CHECK_EQUAL(0, a.live_blocks);
}

static const float sample_data[24] = {1, 2, 3, 4, 5, 6, -7, 8.5f, 1e-40f, 3e38f, -0.0f, 0};

/* Writes the sample archive: a matrix, a scalar, an empty tensor and a rank 4 one, and metadata that needs escapes. */
static unsigned char *sample_file(dist_context *ctx, size_t *size)
{
    static const char *const keys[3] = {"format", "quote \" and \\ and \n\x1f", "\xc3\xa9\xf0\x9f\x98\x80"};
    static const char *const values[3] = {"dist-net-1", "", "1e-05"};
    disti_tensor_out tensors[4];
    memset(tensors, 0, sizeof tensors);
    tensors[0].name = "lin0.weight";
    tensors[0].rank = 2;
    tensors[0].shape[0] = 2;
    tensors[0].shape[1] = 3;
    tensors[1].name = "scalar";
    tensors[2].name = "empty \"";
    tensors[2].rank = 1;
    tensors[3].name = "a.rank4";
    tensors[3].rank = 4;
    for (int i = 0; i < 4; i++) {
        if (i < 3) tensors[3].shape[i] = 2;
        tensors[i].data = sample_data + i;
    }
    tensors[3].shape[3] = 1;
    CHECK_STATUS(DIST_OK, disti_archive_write(ctx, "dist_x", 4, tensors, 3, keys, values, NULL, 0, size), ctx);
    unsigned char *bytes = (unsigned char *)malloc(*size);
    size_t again = 0;
    if (!bytes) return NULL;
    memset(bytes, 0xcd, *size);
    CHECK_STATUS(DIST_OK, disti_archive_write(ctx, "dist_x", 4, tensors, 3, keys, values, bytes, *size, &again), ctx);
    CHECK_EQUAL(*size, again);
    return bytes;
}

/* ---- reading and writing ----------------------------------------------------------------------------------------- */

TEST(what_is_written_is_read_back)
{
    test_allocator a;
    dist_context *ctx = archive_context(&a);
    disti_archive archive;
    size_t size;
    float out[8];
    unsigned char *bytes = sample_file(ctx, &size);
    CHECK_STATUS(DIST_OK, disti_archive_open(ctx, "dist_x", bytes, size, &archive), ctx);
    CHECK_EQUAL(4, archive.tensor_count);
    CHECK_EQUAL(3, archive.meta_count);
    const disti_tensor *matrix = disti_archive_find(&archive, "lin0.weight");
    const disti_tensor *scalar = disti_archive_find(&archive, "scalar");
    const disti_tensor *empty = disti_archive_find(&archive, "empty \"");
    const disti_tensor *deep = disti_archive_find(&archive, "a.rank4");
    REQUIRE(matrix && scalar && empty && deep);
    CHECK(matrix == &archive.tensors[0] && deep == &archive.tensors[3]);
    CHECK(matrix->rank == 2 && matrix->shape[0] == 2 && matrix->shape[1] == 3 && matrix->count == 6);
    CHECK(scalar->rank == 0 && scalar->count == 1);
    CHECK(empty->rank == 1 && empty->shape[0] == 0 && empty->count == 0);
    CHECK(deep->rank == 4 && deep->shape[3] == 1 && deep->count == 8);
    disti_tensor_read(matrix, out);
    CHECK_BYTES(6 * sizeof(float), sample_data, out);
    disti_tensor_read(scalar, out);
    CHECK_BYTES(sizeof(float), sample_data + 1, out);
    disti_tensor_read(deep, out);
    CHECK_BYTES(8 * sizeof(float), sample_data + 3, out);
    CHECK_TEXT("dist-net-1", disti_archive_meta(&archive, "format"));
    CHECK(disti_archive_meta(&archive, "quote \" and \\ and \n\x1f")[0] == 0);
    CHECK_TEXT("1e-05", disti_archive_meta(&archive, "\xc3\xa9\xf0\x9f\x98\x80"));
    CHECK(disti_archive_meta(&archive, "forma") == NULL);
    CHECK(disti_archive_find(&archive, "lin0") == NULL && disti_archive_find(&archive, "zzz") == NULL);
    CHECK(disti_archive_find(&archive, "") == NULL);
    disti_archive_close(ctx, &archive);
    disti_archive_close(ctx, &archive);
    dist_context_destroy(ctx);
    free(bytes);
    CHECK_EQUAL(0, a.live_blocks);
}

TEST(reading_and_writing_again_gives_the_same_bytes)
{
    test_allocator a;
    dist_context *ctx = archive_context(&a);
    disti_archive archive;
    disti_tensor_out tensors[4];
    float data[4][8];
    size_t size, again;
    unsigned char *bytes = sample_file(ctx, &size);
    unsigned char *copy = (unsigned char *)malloc(size);
    CHECK_STATUS(DIST_OK, disti_archive_open(ctx, "dist_x", bytes, size, &archive), ctx);
    for (int i = 0; i < 4; i++) {
        tensors[i].name = archive.tensors[i].name;
        tensors[i].rank = archive.tensors[i].rank;
        memcpy(tensors[i].shape, archive.tensors[i].shape, sizeof tensors[i].shape);
        tensors[i].data = data[i];
        disti_tensor_read(&archive.tensors[i], data[i]);
    }
    const char *const *keys = archive.keys, *const *values = archive.values;
    CHECK_STATUS(DIST_OK, disti_archive_write(ctx, "dist_x", 4, tensors, 3, keys, values, copy, size, &again), ctx);
    CHECK_EQUAL(size, again);
    CHECK_BYTES(size, bytes, copy);
    disti_archive_close(ctx, &archive);
    dist_context_destroy(ctx);
    free(copy);
    free(bytes);
}

TEST(data_begins_at_a_multiple_of_eight)
{
    dist_context *ctx = test_context();
    char key[9] = "", name[] = "x";
    for (int length = 0; length < 8; length++) {
        const char *const keys[1] = {key}, *const values[1] = {"v"};
        unsigned char bytes[256];
        size_t size;
        disti_tensor_out tensor;
        memset(&tensor, 0, sizeof tensor);
        tensor.name = name;
        tensor.data = sample_data;
        CHECK_STATUS(DIST_OK,
                     disti_archive_write(ctx, "dist_x", 1, &tensor, 1, keys, values, bytes, sizeof bytes, &size), ctx);
        CHECK_EQUAL(0, bytes[0] % 8);
        CHECK_EQUAL(8 + bytes[0] + 4, size);
        key[length] = 'k';
    }
    dist_context_destroy(ctx);
}

TEST(an_archive_of_nothing_is_written_and_read)
{
    dist_context *ctx = test_context();
    disti_archive archive;
    unsigned char bytes[32];
    size_t size;
    CHECK_STATUS(DIST_OK, disti_archive_write(ctx, "dist_x", 0, NULL, 0, NULL, NULL, bytes, sizeof bytes, &size), ctx);
    CHECK_EQUAL(16, size);
    CHECK_BYTES(16, "\10\0\0\0\0\0\0\0{}      ", bytes);
    CHECK_STATUS(DIST_OK, disti_archive_open(ctx, "dist_x", bytes, size, &archive), ctx);
    CHECK(archive.tensor_count == 0 && archive.meta_count == 0);
    CHECK(disti_archive_find(&archive, "x") == NULL && disti_archive_meta(&archive, "x") == NULL);
    disti_archive_close(ctx, &archive);
    dist_context_destroy(ctx);
}

TEST(too_small_a_buffer_is_refused_untouched_with_the_size_needed)
{
    dist_context *ctx = test_context();
    disti_tensor_out tensor;
    unsigned char bytes[200], before[200];
    size_t size = 0;
    memset(&tensor, 0, sizeof tensor);
    memset(bytes, 0xcd, sizeof bytes);
    memcpy(before, bytes, sizeof bytes);
    tensor.name = "x";
    tensor.data = sample_data;
    CHECK_STATUS(DIST_OK, disti_archive_write(ctx, "dist_x", 1, &tensor, 0, NULL, NULL, NULL, 0, &size), ctx);
    size_t needed = size;
    for (size_t capacity = 0; capacity < needed; capacity++) {
        size = 0;
        CHECK_STATUS(DIST_BAD_ARGUMENT,
                     disti_archive_write(ctx, "dist_x", 1, &tensor, 0, NULL, NULL, bytes, capacity, &size), ctx);
        CHECK_EQUAL(needed, size);
    }
    CHECK_TEXT("dist_x: capacity is 0, must be at least ", dist_context_message(ctx));
    CHECK_BYTES(sizeof bytes, before, bytes);
    dist_context_destroy(ctx);
}

TEST(a_tensor_too_large_for_size_t_is_not_written)
{
    dist_context *ctx = test_context();
    disti_tensor_out tensor;
    size_t size = 1;
    memset(&tensor, 0, sizeof tensor);
    tensor.name = "x";
    tensor.rank = 2;
    tensor.shape[0] = tensor.shape[1] = (size_t)-1 / 2;
    CHECK_STATUS(DIST_OUT_OF_MEMORY, disti_archive_write(ctx, "dist_x", 1, &tensor, 0, NULL, NULL, NULL, 0, &size),
                 ctx);
    CHECK_EQUAL(0, size);
    dist_context_destroy(ctx);
}

TEST(header_order_and_data_order_are_independent)
{
    archive_accepted("{'b':{'data_offsets':[4,8],'shape':[1],'dtype':'F32'},"
                     "'a':{'dtype':'F32','shape':[],'data_offsets':[0,4]}}", 8);
}

TEST(white_space_escapes_and_empty_parts_are_accepted)
{
    archive_accepted("{}", 0);
    archive_accepted("{ } \n\t\r ", 0);
    archive_accepted("{'__metadata__':{}}", 0);
    archive_accepted("{ 'a' :\t{ 'dtype' : 'F\\u00332' ,\n'sh\\u0061pe' : [ 1 , 2 ] ,"
                     "'data_offsets' : [ 0 , 8 ] } } ", 8);
    archive_accepted("{'':{'dtype':'F32','shape':[0],'data_offsets':[0,0]}}", 0);
    archive_accepted("{'e':{'dtype':'F32','shape':[0],'data_offsets':[4,4]},"
                     "'a':{'dtype':'F32','shape':[],'data_offsets':[0,4]}}", 4);
}

TEST(every_escape_becomes_its_character)
{
    test_allocator a;
    dist_context *ctx = archive_context(&a);
    disti_archive archive;
    const char *header = "{'__metadata__':{'k':'\\\"\\\\\\/\\b\\f\\n\\r\\t\\u0041\\u007f\\u0080\\u07ff\\u0800\\uD7ff"
                         "\\ue000\\uFFFF\\ud800\\udc00\\uDBFF\\uDFFF'}}";
    CHECK_STATUS(DIST_OK, archive_open(ctx, header, 0, &archive), ctx);
    const char *expected = "\"\\/\b\f\n\r\tA\x7f\xc2\x80\xdf\xbf\xe0\xa0\x80\xed\x9f\xbf\xee\x80\x80\xef\xbf\xbf"
                           "\xf0\x90\x80\x80\xf4\x8f\xbf\xbf";
    REQUIRE(archive.meta_count == 1);
    CHECK_EQUAL(strlen(expected), strlen(archive.values[0]));
    CHECK_BYTES(strlen(expected) + 1, expected, archive.values[0]);
    disti_archive_close(ctx, &archive);
    dist_context_destroy(ctx);
}

TEST(other_dtypes_and_ranks_are_accepted_and_marked)
{
    static const char *const names[12] = {"BOOL", "U8",  "I8",  "F8_E5M2", "F8_E4M3", "I16",
                                          "U16",  "I32", "U32", "F64",     "I64",     "U64"};
    static const size_t sizes[12] = {1, 1, 1, 1, 1, 2, 2, 4, 4, 8, 8, 8};
    dist_context *ctx = test_context();
    disti_archive archive;
    char header[200];
    float untouched = 5;
    for (int i = 0; i < 12; i++) {
        snprintf(header, sizeof header, "{'x':{'dtype':'%s','shape':[3],'data_offsets':[0,%d]}}", names[i],
                 (int)sizes[i] * 3);
        CHECK_STATUS(DIST_OK, archive_open(ctx, header, sizes[i] * 3, &archive), ctx);
        CHECK_EQUAL(DISTI_DTYPE_OTHER, archive.tensors[0].dtype);
        disti_archive_close(ctx, &archive);
    }
    const char *deep = "{'x':{'dtype':'F32','shape':[1,2,1,1,2],'data_offsets':[0,16]}}";
    CHECK_STATUS(DIST_OK, archive_open(ctx, deep, 16, &archive), ctx);
    CHECK_EQUAL(DISTI_DTYPE_OTHER, archive.tensors[0].dtype);
    CHECK(archive.tensors[0].rank == 5 && archive.tensors[0].count == 4);
    disti_tensor_read(&archive.tensors[0], &untouched);
    CHECK_NEAR(5, untouched, 0);
    disti_archive_close(ctx, &archive);
    dist_context_destroy(ctx);
}

/* ---- numbers ----------------------------------------------------------------------------------------------------- */

static disti_tensor number_tensor(int dtype, size_t count, const unsigned char *data)
{
    disti_tensor tensor;
    memset(&tensor, 0, sizeof tensor);
    tensor.dtype = dtype;
    tensor.count = count;
    tensor.data = data;
    return tensor;
}

TEST(every_half_becomes_the_float_of_its_value)
{
    for (unsigned half = 0; half < 65536; half++) {
        unsigned char bytes[2] = {(unsigned char)half, (unsigned char)(half >> 8)};
        disti_tensor tensor = number_tensor(DISTI_F16, 1, bytes);
        unsigned exponent = half >> 10 & 31, fraction = half & 1023;
        uint32_t got, expected = (half >> 15) << 31 | 0x7f800000u | fraction << 13;
        float value = 0;
        disti_tensor_read(&tensor, &value);
        memcpy(&got, &value, sizeof got);
        if (exponent < 31) {
            double number = exponent ? ldexp(1024.0 + fraction, (int)exponent - 25) : ldexp((double)fraction, -24);
            value = (float)number;
            memcpy(&expected, &value, sizeof expected);
            expected |= (half >> 15) << 31;
        }
        CHECK_EQUAL(expected, got);
    }
}

TEST(every_bfloat_becomes_the_float_of_its_bits)
{
    for (unsigned bits = 0; bits < 65536; bits++) {
        unsigned char bytes[2] = {(unsigned char)bits, (unsigned char)(bits >> 8)};
        disti_tensor tensor = number_tensor(DISTI_BF16, 1, bytes);
        uint32_t got;
        float value = 0;
        disti_tensor_read(&tensor, &value);
        memcpy(&got, &value, sizeof got);
        CHECK_EQUAL((uint32_t)bits << 16, got);
    }
}

TEST(data_may_lie_at_any_address)
{
    unsigned char bytes[24];
    float out[4];
    for (size_t shift = 0; shift < 8; shift++) {
        memset(bytes, 0, sizeof bytes);
        memcpy(bytes + shift, "\0\0\x80\x3f\0\0\0\xc0", 8);
        disti_tensor tensor = number_tensor(DISTI_F32, 2, bytes + shift);
        disti_tensor_read(&tensor, out);
        CHECK(out[0] == 1 && out[1] == -2);
        tensor = number_tensor(DISTI_BF16, 4, bytes + shift);
        disti_tensor_read(&tensor, out);
        CHECK(out[0] == 0 && out[1] == 1 && out[2] == 0 && out[3] == -2);
    }
}

/* Parses a text of at most 64 characters that nothing follows. */
static int number_parse(const char *text, double *out, size_t *used)
{
    char copy[64];
    size_t length = strlen(text);
    const char *first = copy + sizeof copy - length, *cursor = first;
    memcpy(copy + sizeof copy - length, text, length);
    int good = disti_parse_double(&cursor, first + length, out);
    *used = (size_t)(cursor - first);
    return good;
}

static void number_check(const char *text)
{
    double got = 0, expected = strtod(text, NULL);
    uint64_t a, b;
    size_t used;
    int good = number_parse(text, &got, &used);
    memcpy(&a, &expected, sizeof a);
    memcpy(&b, &got, sizeof b);
    if (!CHECK(good && used == strlen(text) && a == b))
        printf("    %s: expected %.17g, got %.17g\n", text, expected, got);
}

TEST(numbers_are_rounded_as_strtod_rounds_them)
{
    static const char *const texts[] = {
        "0", "-0", "+1", "1", "0.1", "3.1415", "1e-05", "1E5", "1e+5", "00012.500", "9007199254740993", "5e-1", "1e22",
        "9007199254740992.5e0", "2.2250738585072014e-308", "2.2250738585072011e-308", "4.9406564584124654e-324", "1e23",
        "2.4703282292062327e-324", "2.4703282292062328e-324", "1.7976931348623157e308", "1.7976931348623158e308",
        "8.5e-320", "0e999999999999999999999", "1e-400", "1e-99999999999999999999", "123456789012345678",
        "0.000000000000000000000000000001"};
    test_random r = test_random_seed(5);
    char text[64];
    for (size_t i = 0; i < sizeof texts / sizeof texts[0]; i++) number_check(texts[i]);
    for (int i = 0; i < 20000; i++) {
        double x;
        uint64_t bits = test_random_bits(&r);
        if (i % 2) bits = (bits & 0x800fffffffffffffu) | (uint64_t)(0x3ff - 60 + test_random_int(&r, 0, 120)) << 52;
        memcpy(&x, &bits, sizeof x);
        if (!test_finite(x)) continue;
        snprintf(text, sizeof text, "%.*e", test_random_int(&r, 0, 18), x);
        if (strtod(text, NULL) <= 1.7e308 && strtod(text, NULL) >= -1.7e308) number_check(text);
    }
}

TEST(what_is_no_number_is_refused_and_nothing_is_skipped)
{
    static const char *const texts[] = {"", "-", "+", ".5", "-.5", " 1", "e5", "inf", "nan", "NaN", "Infinity", "-inf",
                                        "x", "--1", "1e309", "-1.7976931348623159e308", "1e99999999999999999999"};
    static const char *const longer[][2] = {{"1.", "1"}, {"1e", "1"}, {"1e+", "1"}, {"1.5.5", "1.5"}, {"2 ", "2"},
                                            {"1,5", "1"}, {"0x10", "0"}, {"3e1.5", "3e1"}, {"1..2", "1"}, {"7-", "7"}};
    double out = 5;
    size_t used;
    for (size_t i = 0; i < sizeof texts / sizeof texts[0]; i++) {
        CHECK(!number_parse(texts[i], &out, &used));
        CHECK_EQUAL(0, used);
        CHECK_NEAR(5, out, 0);
    }
    for (size_t i = 0; i < sizeof longer / sizeof longer[0]; i++) {
        CHECK(number_parse(longer[i][0], &out, &used));
        CHECK_EQUAL(strlen(longer[i][1]), used);
        CHECK_NEAR(strtod(longer[i][1], NULL), out, 0);
    }
}

TEST(a_million_digits_are_read_as_the_number_they_are)
{
    size_t n = 1000000;
    char *text = (char *)malloc(n + 20);
    double out = 0;
    const char *cursor = text;
    memset(text, '0', n);
    memcpy(text, "0.", 2);
    memcpy(text + n, "25e1000000", 10);
    CHECK(disti_parse_double(&cursor, text + n + 10, &out));
    CHECK_NEAR(25, out, 0);
    CHECK(cursor == text + n + 10);
    free(text);
}

/* ---- what is refused --------------------------------------------------------------------------------------------- */

#define ENTRY "'dtype':'F32','shape':[1],'data_offsets':[0,4]"

TEST(what_is_no_json_object_is_refused)
{
    archive_refused(" {}", 0, "must be 123: a '{'");
    archive_refused("[]", 0, "the file has byte 91 at 8");
    archive_refused("{} x", 0, "the header goes on at byte 11 of the file");
    archive_refused("{}{}", 0, "must have only spaces after its object");
    archive_refused("{'a", 0, "a string does not end");
    archive_refused("{'a'", 0, "tensor \"a\" is spoiled: the header ends at byte 12, must go on with ':'");
    archive_refused("{'a':{" ENTRY "},}", 4, "byte 62 of the file is '}', must be '\"'");
    archive_refused("{,}", 0, "byte 9 of the file is ',', must be '\"'");
    archive_refused("{'a' 1}", 0, "is '1', must be ':'");
    archive_refused("{'a':{" ENTRY "}", 4, "must go on with '}'");
    archive_refused("{'a':{" ENTRY "]}", 4, "is ']', must be '}'");
    archive_refused("{'a':null}", 0, "tensor \"a\" is spoiled: byte 13 of the file is 'n', must be '{'");
    archive_refused("{'a':[[[[[[[[[[[[", 0, "is '[', must be '{'");
    archive_refused("{a:{}}", 0, "is 'a', must be '\"'");
}

TEST(strings_that_are_not_json_are_refused)
{
    archive_refused("{'a\n':{" ENTRY "}}", 4, "control character 10");
    archive_refused("{'a\\x':{" ENTRY "}}", 4, "is no escape of JSON");
    archive_refused("{'a\\", 0, "is no escape of JSON");
    archive_refused("{'a\\u12g4':{" ENTRY "}}", 4, "hexadecimal");
    archive_refused("{'a\\u12", 0, "hexadecimal");
    archive_refused("{'a\\u0000':{" ENTRY "}}", 4, "must not be NUL");
    archive_refused("{'a\\ud800':{" ENTRY "}}", 4, "half a surrogate pair");
    archive_refused("{'a\\udc00':{" ENTRY "}}", 4, "half a surrogate pair");
    archive_refused("{'a\\ud800\\u0041':{" ENTRY "}}", 4, "half a surrogate pair");
    archive_refused("{'a\\ud800\\ud800':{" ENTRY "}}", 4, "half a surrogate pair");
    archive_refused("{'a\xff':{" ENTRY "}}", 4, "not UTF-8 at byte 11");
    archive_refused("{'\xc0\x80':{" ENTRY "}}", 4, "not UTF-8 at byte 10");
    archive_refused("{'\xe0\x9f\x80':{" ENTRY "}}", 4, "not UTF-8");
    archive_refused("{'\xed\xa0\x80':{" ENTRY "}}", 4, "not UTF-8");
    archive_refused("{'\xf0\x8f\x80\x80':{" ENTRY "}}", 4, "not UTF-8");
    archive_refused("{'\xf4\x90\x80\x80':{" ENTRY "}}", 4, "not UTF-8");
    archive_refused("{}\xe2\x82", 0, "not UTF-8 at byte 10");
}

TEST(entries_with_wrong_fields_are_refused)
{
    archive_refused("{'a':{}}", 0, "tensor \"a\" has no field dtype");
    archive_refused("{'a':{'dtype':'F32','data_offsets':[0,4]}}", 4, "has no field shape");
    archive_refused("{'a':{'dtype':'F32','shape':[]}}", 4, "has no field data_offsets");
    archive_refused("{'a':{" ENTRY ",'x':{'y':[]}}}", 4, "tensor \"a\" has the field 'x', must have dtype, shape");
    archive_refused("{'a':{" ENTRY ",'shape':[1]}}", 4, "has the field shape twice");
    archive_refused("{'a':{'dtype':'F33','shape':[1],'data_offsets':[0,4]}}", 4, "has the dtype 'F33', must be F32,");
    archive_refused("{'a':{'dtype':'f32','shape':[1],'data_offsets':[0,4]}}", 4, "has the dtype 'f32'");
    archive_refused("{'a':{'dtype':32,'shape':[1],'data_offsets':[0,4]}}", 4, "is '3', must be '\"'");
    archive_refused("{'a':{'dtype':'F32','shape':1,'data_offsets':[0,4]}}", 4, "is '1', must be '['");
    archive_refused("{'a':{'dtype':'F32','shape':[[1]],'data_offsets':[0,4]}}", 4, "not a plain non-negative integer");
}

TEST(numbers_that_are_no_sizes_are_refused)
{
    static const char *const numbers[] = {"-1", "1.0", "1e0", "01", "00", "+1", "0x1", "", "\\\"1\\\"", "true", "1E2"};
    char header[200];
    for (size_t i = 0; i < sizeof numbers / sizeof numbers[0]; i++) {
        snprintf(header, sizeof header, "{'a':{'dtype':'U8','shape':[2,%s],'data_offsets':[0,2]}}", numbers[i]);
        archive_refused(header, 2, strcmp(numbers[i], "0x1") ? "has in shape at byte" : "is 'x', must be ']'");
    }
    archive_refused("{'a':{'dtype':'U8','shape':[99999999999999999999999999],'data_offsets':[0,2]}}", 2,
                    "has in shape at byte 36 of the file a number that does not fit");
    archive_refused("{'a':{'dtype':'U8','shape':[18446744073709551616],'data_offsets':[0,2]}}", 2, "does not fit");
    archive_refused("{'a':{'dtype':'U8','shape':[2],'data_offsets':[0,18446744073709551618]}}", 2, "does not fit");
}

TEST(shapes_and_offsets_that_do_not_fit_are_refused)
{
    archive_refused("{'a':{'dtype':'U8','shape':[4294967296,4294967296],'data_offsets':[0,0]}}", 0, "does not fit");
    archive_refused("{'a':{'dtype':'F64','shape':[2305843009213693952],'data_offsets':[0,0]}}", 0, "does not fit");
    archive_refused("{'a':{'dtype':'F32','shape':[2],'data_offsets':[0,4]}}", 4,
                    "has 4 bytes by its data_offsets, must be 8");
    archive_refused("{'a':{'dtype':'F16','shape':[1],'data_offsets':[0,4]}}", 4,
                    "has 4 bytes by its data_offsets, must be 2");
    archive_refused("{'a':{'dtype':'F32','shape':[1],'data_offsets':[0,4]}}", 3,
                    "that end at 4, must be from their begin to 3");
    archive_refused("{'a':{'dtype':'F32','shape':[1],'data_offsets':[4,0]}}", 4, "has data_offsets that end at 0");
    archive_refused("{'a':{'dtype':'F32','shape':[1],'data_offsets':[0]}}", 4, "has 1 data_offsets, must be 2");
    archive_refused("{'a':{'dtype':'F32','shape':[1],'data_offsets':[0,4,8]}}", 8, "has 3 data_offsets, must be 2");
    archive_refused("{'a':{'dtype':'F32','shape':[1],'data_offsets':[]}}", 8, "has 0 data_offsets, must be 2");
}

TEST(overlaps_and_holes_are_refused)
{
    archive_refused("{'a':{" ENTRY "},'b':{" ENTRY "}}", 8,
                    "leaves an overlap: its data_offsets begin at 0, must begin at 4");
    archive_refused("{'a':{" ENTRY "},'b':{'dtype':'F32','shape':[1],'data_offsets':[5,9]}}", 9,
                    "tensor \"b\" leaves a hole: its data_offsets begin at 5, must begin at 4");
    archive_refused("{'a':{" ENTRY "},'b':{'dtype':'F32','shape':[1],'data_offsets':[3,7]}}", 7, "an overlap");
    archive_refused("{'a':{" ENTRY "},'b':{'dtype':'F32','shape':[0],'data_offsets':[3,3]}}", 4, "an overlap");
    archive_refused("{'a':{'dtype':'F32','shape':[1],'data_offsets':[4,8]}}", 8, "begin at 4, must begin at 0");
    archive_refused("{'a':{" ENTRY "}}", 5, "the file has 5 bytes of data, must have 4 for its tensors");
    archive_refused("{}", 1, "the file has 1 bytes of data, must have 0");
}

TEST(names_that_stand_twice_are_refused)
{
    archive_refused("{'a':{" ENTRY "},'\\u0061':{'dtype':'F32','shape':[1],'data_offsets':[4,8]}}", 8,
                    "tensor \"a\" stands in the header twice");
    archive_refused("{'__metadata__':{'k':'1','j':'2','k':'3'}}", 0, "metadata key \"k\" stands in the header twice");
    archive_refused("{'__metadata__':{},'__metadata__':{}}", 0, "has __metadata__ twice");
    archive_refused("{'__metadata__':{'k':1}}", 0,
                    "metadata key \"k\" is spoiled: byte 29 of the file is '1', must be '\"'");
    archive_refused("{'__metadata__':[]}", 0, "is '[', must be '{'");
}

TEST(a_hostile_name_cannot_spoil_the_sentence)
{
    test_allocator a;
    dist_context *ctx = archive_context(&a);
    disti_archive archive;
    char header[2100] = "{'%s%d%n\x7f\xc3\xa9\\n";
    size_t n = strlen(header);
    memset(header + n, '%', 2000);
    memcpy(header + n + 2000, "\":{}}", 6);
    CHECK_STATUS(DIST_BAD_FILE, archive_open(ctx, header, 0, &archive), ctx);
    CHECK_TEXT("tensor \"?s?d?n???\\n????", dist_context_message(ctx));
    CHECK_TEXT("\" has no field dtype", dist_context_message(ctx));
    CHECK(strlen(dist_context_message(ctx)) < 200);
    dist_context_destroy(ctx);
}

TEST(what_is_not_safetensors_at_all_is_named)
{
    static const struct {
        const char *bytes;
        size_t size;
        const char *part;
    } files[] = {{"", 0, "the file has 0 bytes, a safetensors file has at least 10"},
                 {"\2\0\0\0\0\0\0", 7, "has 7 bytes"},
                 {"\2\0\0\0\0\0\0\0{", 9, "has 9 bytes"},
                 {"\3\0\0\0\0\0\0\0{}", 10, "has a header length of 3, must be 2 to 2"},
                 {"\1\0\0\0\0\0\0\0{}", 10, "has a header length of 1, must be 2"},
                 {"\0\0\0\0\0\0\0\0{}", 10, "has a header length of 0"},
                 {"\xff\xff\xff\xff\xff\xff\xff\xff{}", 10, "has a header length of 1.84467e19, must be 2 to 2"},
                 {"\xf9\xff\xff\xff\xff\xff\xff\xff{}", 10, "has a header length of"},
                 {"\0\0\0\0\0\0\0\x80{}", 10, "has a header length of"},
                 {"PK\3\4\0\0\x08\x08\0\0\0\0", 12,
                  "is a zip (PyTorch checkpoint, or .npz), must be safetensors: save the"},
                 {"PK\3\4", 4, "PyTorch checkpoint"},
                 {"\x80\2\x8a\nl\xfc\x9c" "F\xf9 j", 11, "is a PyTorch checkpoint (pickle)"},
                 {"GGUF\3\0\0\0\0\0\0\0", 12, "is a GGUF file"},
                 {"\x93NUMPY\1\0v\0{'descr'", 16, "is a numpy file"},
                 {"\x89HDF\r\n\x1a\n\0\0\0\0", 12, "is an HDF5 file"}};
    for (size_t i = 0; i < sizeof files / sizeof files[0]; i++) {
        dist_context *ctx = test_context();
        disti_archive archive;
        unsigned char *bytes = (unsigned char *)malloc(files[i].size ? files[i].size : 1);
        memcpy(bytes, files[i].bytes, files[i].size);
        CHECK_STATUS(DIST_BAD_FILE, disti_archive_open(ctx, "dist_x", bytes, files[i].size, &archive), ctx);
        CHECK_TEXT(files[i].part, dist_context_message(ctx));
        free(bytes);
        dist_context_destroy(ctx);
    }
}

/* ---- hostile sizes and memory ------------------------------------------------------------------------------------ */

TEST(every_truncation_is_refused)
{
    test_allocator a;
    dist_context *ctx = archive_context(&a);
    size_t size, before = a.live_blocks;
    unsigned char *bytes = sample_file(ctx, &size);
    for (size_t n = 0; n < size; n++) {
        disti_archive archive;
        unsigned char *part = (unsigned char *)malloc(n ? n : 1);
        memcpy(part, bytes, n);
        dist_context_clear(ctx);
        CHECK_STATUS(DIST_BAD_FILE, disti_archive_open(ctx, "dist_x", part, n, &archive), ctx);
        CHECK(dist_context_message(ctx)[0] != 0);
        free(part);
    }
    CHECK_EQUAL(before, a.live_blocks);
    dist_context_destroy(ctx);
    free(bytes);
}

TEST(a_refused_allocation_leaves_nothing_behind)
{
    for (size_t n = 1;; n++) {
        test_allocator a;
        dist_context *ctx = archive_context(&a);
        disti_archive archive;
        size_t size, before = a.live_blocks;
        unsigned char *bytes = sample_file(ctx, &size);
        a.fail_at = a.requests + n;
        dist_status status = disti_archive_open(ctx, "dist_x", bytes, size, &archive);
        size_t refused = a.refused;
        CHECK_STATUS(refused ? DIST_OUT_OF_MEMORY : DIST_OK, status, ctx);
        if (refused) CHECK_EQUAL(before, a.live_blocks);
        disti_archive_close(ctx, &archive);
        CHECK_EQUAL(before, a.live_blocks);
        dist_context_destroy(ctx);
        free(bytes);
        CHECK_EQUAL(0, a.live_blocks);
        if (!refused) break;
        REQUIRE(n < 100);
    }
}

/* A header of count empty tensors, last name first; twin: the name 8 stands twice. */
static char *many_tensors(int count, int twin)
{
    char *header = (char *)malloc((size_t)count * 80 + 100), *end = header;
    *end++ = '{';
    for (int i = count - 1; i >= 0; i--)
        end += sprintf(end, "%s'%d':{'dtype':'U8','shape':[0],'data_offsets':[0,0]}", i == count - 1 ? "" : ",",
                       twin && i == 7 ? 8 : i);
    memcpy(end, "}", 2);
    return header;
}

TEST(two_hundred_thousand_tensors_take_little_time_and_memory)
{
    int count = test_quick() ? 20000 : 200000;
    test_allocator a;
    dist_context *ctx = archive_context(&a);
    disti_archive archive;
    size_t before = a.live_bytes;
    char *header = many_tensors(count, 0), name[16];
    CHECK_STATUS(DIST_OK, archive_open(ctx, header, 0, &archive), ctx);
    CHECK(a.peak_bytes - before <= strlen(header) * 17 / 10);
    for (int i = 0; i < count; i += 97) {
        snprintf(name, sizeof name, "%d", i);
        CHECK(disti_archive_find(&archive, name) == &archive.tensors[count - 1 - i]);
    }
    disti_archive_close(ctx, &archive);
    free(header);
    header = many_tensors(count, 1);
    CHECK_STATUS(DIST_BAD_FILE, archive_open(ctx, header, 0, &archive), ctx);
    CHECK_TEXT("tensor \"8\" stands in the header twice", dist_context_message(ctx));
    free(header);
    dist_context_destroy(ctx);
    CHECK_EQUAL(0, a.live_blocks);
}

TEST(metadata_beyond_its_limit_is_refused)
{
    char *header = (char *)malloc(DISTI_META_MAX * 12 + 100), *end = header;
    end += sprintf(end, "{'__metadata__':{");
    for (int i = 0; i < DISTI_META_MAX; i++) end += sprintf(end, "%s\"%x\":\"\"", i ? "," : "", (unsigned)i);
    memcpy(end, "}}", 3);
    archive_accepted(header, 0);
    memcpy(end, ",\"last\":\"\"}}", 13);
    archive_refused(header, 0, "metadata key \"last\" is one too many, there must be at most 65536");
    free(header);
}

/* Opens and, if that succeeds, reads everything. Returns whether it opened. */
static int fuzz_one(dist_context *ctx, const unsigned char *bytes, size_t size)
{
    disti_archive archive;
    float *out;
    dist_context_clear(ctx);
    dist_status status = disti_archive_open(ctx, "dist_x", bytes, size, &archive);
    if (status != DIST_OK) {
        CHECK_STATUS(DIST_BAD_FILE, status, ctx);
        CHECK(strncmp(dist_context_message(ctx), "dist_x: ", 8) == 0);
        CHECK(archive.block == NULL);
        return 0;
    }
    for (size_t i = 0; i < archive.tensor_count; i++) {
        const disti_tensor *tensor = &archive.tensors[i];
        CHECK(disti_archive_find(&archive, tensor->name) == tensor);
        if (tensor->dtype == DISTI_DTYPE_OTHER) continue;
        out = (float *)malloc(tensor->count * sizeof(float) + 1);
        disti_tensor_read(tensor, out);
        free(out);
    }
    for (size_t i = 0; i < archive.meta_count; i++) {
        const char *text = archive.values[i];
        double number;
        CHECK(disti_archive_meta(&archive, archive.keys[i]) == text);
        disti_parse_double(&text, text + strlen(text), &number);
    }
    disti_archive_close(ctx, &archive);
    return 1;
}

/* Changes bytes (size, capacity) in one of several ways and returns the new size. */
static size_t fuzz_mutate(test_random *r, unsigned char *bytes, size_t size, size_t capacity)
{
    static const char *const numbers[19] = {
        "0", "1", "4", "255", "65536", "4294967295", "18446744073709551615", "99999999999999999999", "-1", "1e3", "{",
        "}", "\\u0000", "\\ud83d\\ude00", "\"F64\"", "\"BF16\"", "[]", ",", "\"\""};
    size_t at = size ? (size_t)test_random_int(r, 0, (int)size - 1) : 0;
    size_t from = size ? (size_t)test_random_int(r, 0, (int)size - 1) : 0;
    size_t piece = (size_t)test_random_int(r, 1, 40), length;
    const char *number = numbers[test_random_int(r, 0, 18)];
    if (size < 10) return size;
    switch (test_random_int(r, 0, 6)) {
    case 0: bytes[at] = (unsigned char)(bytes[at] ^ 1 << test_random_int(r, 0, 7)); break;
    case 1: bytes[at] = (unsigned char)test_random_int(r, 0, 255); break;
    case 2: return at;
    case 3: /* copies one piece over another */
        length = LESSER(piece, size - GREATER(at, from));
        memmove(bytes + at, bytes + from, length);
        break;
    case 4: /* a piece goes; the header's length follows */
        length = LESSER(piece, size - at);
        memmove(bytes + at, bytes + at + length, size - at - length);
        if (at >= 8) bytes[0] = (unsigned char)(bytes[0] - length);
        return size - length;
    case 5: /* a digit becomes another number, and the header grows by what that adds */
        while (at < size && (bytes[at] < '0' || bytes[at] > '9')) at++;
        length = strlen(number);
        if (at < 8 || at >= size || size + length > capacity) break;
        memmove(bytes + at + length, bytes + at + 1, size - at - 1);
        memcpy(bytes + at, number, length);
        if (bytes[0] + length < 257) bytes[0] = (unsigned char)(bytes[0] + length - 1);
        return size + length - 1;
    case 6: bytes[test_random_int(r, 0, 7)] = (unsigned char)test_random_int(r, 0, 255); break;
    }
    return size;
}

TEST(twenty_thousand_mutations_are_opened_or_refused_cleanly)
{
    static const char *const headers[3] = {
        "{'a':{'dtype':'F16','shape':[2,2],'data_offsets':[4,12]},'b':{'dtype':'F32','shape':[],'data_offsets':[0,4]}}",
        "{'__metadata__':{'k\\u00e9':'3.1415','l':'1e-05'},'x':{'dtype':'BF16','shape':[6],'data_offsets':[0,12]}}",
        NULL};
    test_allocator a;
    dist_context *ctx = archive_context(&a);
    test_random r = test_random_seed(2020);
    size_t opened = 0, before = a.live_blocks;
    unsigned char work[2048];
    for (int i = 0; i < (test_quick() ? 2000 : 20000); i++) {
        size_t size;
        unsigned char *file = headers[i % 3] ? archive_file(headers[i % 3], 12, &size) : sample_file(ctx, &size);
        memcpy(work, file, size);
        free(file);
        for (int k = test_random_int(&r, 1, 3); k > 0; k--) size = fuzz_mutate(&r, work, size, sizeof work);
        file = (unsigned char *)malloc(size ? size : 1); /* its exact size, for the address sanitizer */
        memcpy(file, work, size);
        opened += (size_t)fuzz_one(ctx, file, size);
        free(file);
    }
    CHECK_EQUAL(before, a.live_blocks);
    CHECK(opened > 20);
    dist_context_destroy(ctx);
}

TEST(real_models_open)
{
    static const char *const names[8] = {"bob_spot", "bunny_relu", "chairs", "deepsdf_512", "deepsdf_512_he", "fox",
                                         "mug_camera_bottle", "primitives"};
    dist_context *ctx = test_context();
    int found = 0;
    for (int i = 0; i < 8; i++) {
        char name[64];
        disti_archive archive;
        size_t size;
        snprintf(name, sizeof name, "nets/%s.safetensors", names[i]);
        unsigned char *bytes = (unsigned char *)test_file_read(test_data_path(name), &size);
        if (!bytes) continue;
        found++;
        CHECK_STATUS(DIST_OK, disti_archive_open(ctx, "dist_x", bytes, size, &archive), ctx);
        CHECK(archive.tensor_count > 0);
        for (size_t k = 0; k < archive.tensor_count; k++) CHECK(archive.tensors[k].dtype != DISTI_DTYPE_OTHER);
        CHECK_TEXT("dist-net-1", disti_archive_meta(&archive, "format"));
        CHECK_EQUAL(1, fuzz_one(ctx, bytes, size));
        disti_archive_close(ctx, &archive);
        free(bytes);
    }
    dist_context_destroy(ctx);
    if (found < 8) SKIP("not all models are in DIST_DATA or ../shared/data");
}

static void run_archive(void)
{
    RUN(what_is_written_is_read_back);
    RUN(reading_and_writing_again_gives_the_same_bytes);
    RUN(data_begins_at_a_multiple_of_eight);
    RUN(an_archive_of_nothing_is_written_and_read);
    RUN(too_small_a_buffer_is_refused_untouched_with_the_size_needed);
    RUN(a_tensor_too_large_for_size_t_is_not_written);
    RUN(header_order_and_data_order_are_independent);
    RUN(white_space_escapes_and_empty_parts_are_accepted);
    RUN(every_escape_becomes_its_character);
    RUN(other_dtypes_and_ranks_are_accepted_and_marked);
    RUN(every_half_becomes_the_float_of_its_value);
    RUN(every_bfloat_becomes_the_float_of_its_bits);
    RUN(data_may_lie_at_any_address);
    RUN(numbers_are_rounded_as_strtod_rounds_them);
    RUN(what_is_no_number_is_refused_and_nothing_is_skipped);
    RUN(a_million_digits_are_read_as_the_number_they_are);
    RUN(what_is_no_json_object_is_refused);
    RUN(strings_that_are_not_json_are_refused);
    RUN(entries_with_wrong_fields_are_refused);
    RUN(numbers_that_are_no_sizes_are_refused);
    RUN(shapes_and_offsets_that_do_not_fit_are_refused);
    RUN(overlaps_and_holes_are_refused);
    RUN(names_that_stand_twice_are_refused);
    RUN(a_hostile_name_cannot_spoil_the_sentence);
    RUN(what_is_not_safetensors_at_all_is_named);
    RUN(every_truncation_is_refused);
    RUN(a_refused_allocation_leaves_nothing_behind);
    RUN(two_hundred_thousand_tensors_take_little_time_and_memory);
    RUN(metadata_beyond_its_limit_is_refused);
    RUN(twenty_thousand_mutations_are_opened_or_refused_cleanly);
    RUN(real_models_open);
}
