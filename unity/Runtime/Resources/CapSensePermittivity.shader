// Draws an object in its permittivity code: 1 to 254 the relative permittivity itself, 255 a
// conductor. For a CapacitiveSensor that reads permittivity codes.
Shader "CapSense/Permittivity"
{
    Properties
    {
        _Permittivity ("Code", Range(0, 255)) = 60
    }
    SubShader
    {
        Tags { "RenderType" = "Opaque" }
        Pass
        {
            Cull Off
            HLSLPROGRAM
            #pragma vertex vert
            #pragma fragment frag
            #include "UnityCG.cginc"

            float _Permittivity;

            float4 vert (float4 vertex : POSITION) : SV_POSITION
            {
                return UnityObjectToClipPos(vertex);
            }

            float4 frag () : SV_Target
            {
                return float4(_Permittivity / 255.0, 0, 0, 1);
            }
            ENDHLSL
        }
    }
}
